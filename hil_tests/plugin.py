"""Pytest plugin: fixtures for a star tracker on a serial line or a CAN bus, emulated or real.

In a test::

    def test_it_tracks(starhil_serial):
        starhil_serial.command("set_mode", mode="lost_in_space")
        starhil_serial.wait_for("precise_attitude", lambda reading: reading["valid"], within_s=20)

Without options, an emulator process is started for a module, reset before each test, and ended after the module.
With `--starhil-serial DEV` or `--starhil-can CHANNEL`, the same tests run against a connected unit, and a test that
needs another link or an emulator is skipped. The time-out of a reply is `--starhil-timeout` seconds; a test that
needs another one passes `timeout_s`.

pytest loads this module in every run, so the bench is imported only when a fixture is used.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from starhil.hil_tests.client import ObcClient
    from starhil.hil_tests.rig.control import ControlClient, Truth
    from starhil.hil_tests.rig.emulator_process import EmulatorProcess
    from starhil.protocol.files.bundled import Kind


FILE_OPTIONS: Final[dict[Kind, str]] = {"unit": "--starhil-unit", "profile": "--starhil-profile"}
"""Options that name what ships with the package, or a file."""
SHORTEST_S: Final = 0.01
LONGEST_S: Final = 1e6
"""Limits of `--starhil-timeout`, seconds."""
_EMULATOR_LINKS: Final = (None, "auto", "off")
"""Values of the options of links that name no unit."""


def _seconds(text: str) -> float:
    """Return a time-out; pytest makes one line of the ValueError."""
    seconds = float(text)
    if not SHORTEST_S <= seconds <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"must be {SHORTEST_S:g} to {LONGEST_S:g} s, not {text}")
    return seconds


def _link(text: str) -> str:
    """Return the value of an option of a link."""
    if not text:
        raise argparse.ArgumentTypeError("must not be empty; omit the option for an emulator")
    return text


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options that name a unit or the profile of the emulator."""
    group = parser.getgroup("starhil", "star tracker under test")
    group.addoption(
        "--starhil-serial",
        metavar="DEV",
        type=_link,
        help="serial port of a unit, instead of an emulator (auto); off: none",
    )
    group.addoption(
        "--starhil-can",
        metavar="CHANNEL",
        type=_link,
        help="CAN channel of a unit, instead of an emulator (auto); off: none",
    )
    group.addoption(
        "--starhil-dialect",
        choices=["a", "b", "c"],
        help="format of serial replies, for a unit that has several (default b)",
    )
    group.addoption(
        "--starhil-unit",
        default=None,
        metavar="UNIT",
        help="name or folder of the unit's definition (default: the profile's, or cubestar)",
    )
    group.addoption("--starhil-profile", metavar="PROFILE", help="profile of the emulator")
    group.addoption(
        "--starhil-seed", default=1, type=int, metavar="N", help="seed of the emulator (default 1)"
    )
    group.addoption(
        "--starhil-timeout",
        default=10.0,
        type=_seconds,
        metavar="S",
        help="time-out of a reply (default 10 s)",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "starhil(profile=None, settings=()): profile and settings of the emulator for a test"
    )
    for kind, option in FILE_OPTIONS.items():
        if (name := config.getoption(option)) is not None:
            from starhil.protocol.files.bundled import find, not_found

            if not find(kind, name).exists():
                raise pytest.UsageError(f"{option}: {not_found(kind, name)}")


@contextmanager
def _failing_in_one_line() -> Iterator[None]:
    """Let a test fail without a traceback if its fixture cannot be made."""
    from starhil.protocol.errors import OneLineError

    try:
        yield
    except OneLineError as error:
        raise pytest.fail.Exception("\n".join(error.problems), pytrace=False) from None


class _Emulators:
    """The emulators of a module, one after the other; a test with another profile gets another one."""

    def __init__(self, config: pytest.Config, folder: Path) -> None:
        self._config = config
        self._folder = folder
        self._started = 0
        self._stack = ExitStack()
        self._wanted: tuple[str | None, tuple[str, ...]] | None = None
        self._running: EmulatorProcess | None = None

    def get(self, profile: str | None, settings: tuple[str, ...]) -> EmulatorProcess:
        """Return an emulator after power-on: the running one, reset, or a new one."""
        from starhil.hil_tests.rig.control import ControlClient
        from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
        from starhil.hil_tests.rig.private_can_bus import private_can_bus

        if self._running is not None and self._wanted == (profile, settings):
            with ControlClient(self._running.ready["control"]) as control:
                control.reset()
            return self._running
        self.close()
        self._started += 1
        option = self._config.getoption
        command = emulator_command(
            profile=profile,
            unit=option("--starhil-unit"),
            serial="auto",
            can=self._stack.enter_context(private_can_bus()),
            dialect=option("--starhil-dialect"),
            seed=option("--starhil-seed"),
            settings=settings,
            state_dir=self._folder / f"state-{self._started}",
            truth_log=self._folder / f"truth-{self._started}.csv",
            extra=["--control", "auto"],
        )
        self._running = self._stack.enter_context(EmulatorProcess(command))
        self._wanted = (profile, settings)
        return self._running

    def close(self) -> None:
        """End the emulator; an exit status other than 0 is an error."""
        self._running = None
        self._stack.close()


@pytest.fixture(scope="module")
def _starhil_emulators(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[_Emulators]:
    emulators = _Emulators(request.config, tmp_path_factory.mktemp("starhil"))
    yield emulators
    with _failing_in_one_line():
        emulators.close()


def _unit_option(config: pytest.Config) -> str:
    """Return the option that names a unit, or an empty text if tests run with an emulator."""
    return next(
        (
            name
            for name in ("--starhil-serial", "--starhil-can")
            if config.getoption(name) not in _EMULATOR_LINKS
        ),
        "",
    )


@pytest.fixture
def starhil_emulator(request: pytest.FixtureRequest) -> EmulatorProcess:
    """Return an emulator on a pty and on a CAN bus (vcan0, or else a private hub), as after power-on.

    `.ready` has the fields of its ready line. The marker `starhil` selects its profile.
    """
    unit = _unit_option(request.config)
    if unit:
        pytest.skip(f"{unit} names a unit, and this test needs an emulator")
    marker = request.node.get_closest_marker("starhil")
    options = {} if marker is None else dict(marker.kwargs)
    profile, settings = options.pop("profile", None), options.pop("settings", ())
    texts = [*settings, profile or ""] if isinstance(settings, (list, tuple)) else [None]
    right = all(isinstance(text, str) and "\0" not in text for text in texts)
    if not right or options or (marker is not None and marker.args):
        pytest.fail(
            'the marker starhil takes profile="NAME" and settings=["section.key=value", …]', pytrace=False
        )
    profile, settings = profile or request.config.getoption("--starhil-profile"), tuple(settings)
    emulators: _Emulators = request.getfixturevalue("_starhil_emulators")
    with _failing_in_one_line():
        return emulators.get(profile, settings)


def _client(request: pytest.FixtureRequest, link: str) -> ObcClient:
    from starhil.hil_tests.client import ObcClient

    option = request.config.getoption
    spec, unit, other = option(f"--starhil-{link}"), option("--starhil-unit"), _unit_option(request.config)
    if spec == "off":
        pytest.skip(f"--starhil-{link} off")
    if spec not in _EMULATOR_LINKS and request.node.get_closest_marker("starhil") is not None:
        pytest.skip(f"{other} names a unit, and the marker starhil needs an emulator")
    if spec in _EMULATOR_LINKS and other:
        where = {"serial": "port", "can": "bus"}[link]
        pytest.skip(f"{other} names a unit; give its {where} with --starhil-{link} to run this test")
    if spec in _EMULATOR_LINKS:
        emulator: EmulatorProcess = request.getfixturevalue("starhil_emulator")
        spec, unit = emulator.ready.get(link), emulator.unit
        if spec is None:
            pytest.fail(f"unit {unit} has no {link} link", pytrace=False)
    common = {"unit": unit or "cubestar", "timeout_s": option("--starhil-timeout")}
    with _failing_in_one_line():
        if link == "can":
            return ObcClient.open(can=spec, **common)
        return ObcClient.open(serial=spec, dialect=option("--starhil-dialect"), **common)


@pytest.fixture
def starhil_serial(request: pytest.FixtureRequest) -> Iterator[ObcClient]:
    """Return an OBC client on the serial line of the unit or emulator."""
    with _client(request, "serial") as client:
        yield client


@pytest.fixture
def starhil_can(request: pytest.FixtureRequest) -> Iterator[ObcClient]:
    """Return an OBC client on the CAN bus of the unit or emulator."""
    with _client(request, "can") as client:
        yield client


@pytest.fixture
def starhil_control(starhil_emulator: EmulatorProcess) -> Iterator[ControlClient]:
    """Return a client of the emulator's control channel: `do(action, **keys)`."""
    from starhil.hil_tests.rig.control import ControlClient

    with ControlClient(starhil_emulator.ready["control"]) as control:
        yield control


@pytest.fixture
def starhil_truth(starhil_control: ControlClient, starhil_emulator: EmulatorProcess) -> Truth:
    """Return the truth of the emulator: `point`, `set`, `attitude` and `error`."""
    from starhil.hil_tests.rig.control import Truth
    from starhil.protocol.files.bundled import DEFAULT_UNIT
    from starhil.protocol.unit import load_unit

    return Truth(starhil_control, load_unit(starhil_emulator.unit or DEFAULT_UNIT).conventions)
