"""The exported FMU in FMPy: its description, a tumble, repetition, and what ends first."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import binom, chi2

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.rig.emulator_process import emulator_command, installed_command
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES_TABLES
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.process

if shutil.which("cc") is None:
    pytest.skip("no C compiler (cc) here", allow_module_level=True)
fmpy = pytest.importorskip("fmpy", reason="the package fmpy is not installed")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.fmi2 import FMU2Slave  # noqa: E402
from fmpy.fmi3 import FMU3Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

STEP_S = 0.1
ERROR = 3
"""FMI status of a call that fails."""
LOCK_STEP = [
    *("truth.kind=live", "truth.protocol=tcp", "truth.port=0", "truth.lockstep=true", "run.clock=stepped"),
]
WRONG = "wrong.toml"
"""Profile in the working folder with a key that there is not; it names no images, so that nothing renders them ahead."""
QUICK = "quick.toml"
"""Profile beside an FMU that starts quickly, as images do not matter."""
WITHIN_3_SIGMA = 0.9973
CHANCE = 1e-3
"""Probability that Gaussian errors of the stated covariance fail a test by the size of its sample."""
ARCSEC_PER_RAD = 206_264.8


@pytest.fixture(scope="module")
def fmu2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export("2", tmp_path_factory.mktemp("fmü2"))


def export(fmi: str, folder: Path) -> Path:
    profile = folder / QUICK
    profile.write_text(f'extends = "ideal"\n[parameters]\nstart_mode = "lost_in_space"\n{NO_IMAGES_TABLES}')
    target = folder / f"fmi{fmi}.fmu"
    done = run_command_line("fmu", "export", str(profile), "--fmi", fmi, "-o", str(target))
    assert done == (0, "", "")
    return target


@pytest.fixture(scope="module")
def fmu3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export("3", tmp_path_factory.mktemp("fmü3"))  # the path of the profile is not ASCII


@contextlib.contextmanager
def refused(function: str) -> Iterator[None]:
    """The FMU itself answers a call of this function with the status of an error."""
    with pytest.raises(FMICallException) as caught:
        yield
    assert (caught.value.function, caught.value.status) == (function, ERROR)


def tumble(seconds: float) -> np.ndarray:
    """A torque-free asymmetric body: time, quaternion ICRS→body that rotates vectors, rate in degrees per second."""
    inertia, rate = np.array([0.05, 0.14, 0.10]), np.radians([0.2, -0.1, 0.2])
    to_icrs, fine, rows = Rotation.identity(), STEP_S / 4, []
    for t in np.arange(0.0, seconds + STEP_S / 2, STEP_S):
        rows.append((t, *to_icrs.inv().as_quat(), *np.degrees(rate)))
        for _ in range(4):
            middle = rate - 0.5 * fine * np.cross(rate, inertia * rate) / inertia
            to_icrs *= Rotation.from_rotvec(middle * fine)
            rate = rate - fine * np.cross(middle, inertia * middle) / inertia
    names = ["time", *(f"q_{i}" for i in range(1, 5)), *(f"rate_{axis}" for axis in "xyz")]
    return np.array(rows, dtype=[(name, float) for name in names])


OUTPUTS = [
    *(f"measured_q{axis}" for axis in "xyzw"),
    *(f"measured_w{axis}_deg_s" for axis in "xyz"),
    *("valid", "frame", "exposure_s", "sigma_cross", "sigma_roll", "stars_matched"),
]


def simulate(path: Path, inputs: np.ndarray, step_s: float = STEP_S, **parameters: str) -> np.ndarray:
    start, stop = (float(inputs["time"][row]) for row in (0, -1))
    return fmpy.simulate_fmu(
        str(path), start_time=start, stop_time=stop, step_size=step_s, output_interval=step_s, input=inputs, output=OUTPUTS,
        start_values={"serial": "off", "can": "off", **parameters},
    )  # fmt: skip


@contextlib.contextmanager
def stepped_emulator(folder: Path, profile: Path) -> Iterator[dict[str, str]]:
    """An emulator in lock-step, as the parameters with which an FMU connects to it."""
    command = emulator_command(
        profile=str(profile), serial="off", can="off", settings=LOCK_STEP, extra=["--control", f"unix:{folder}/control"]
    )  # fmt: skip
    with EmulatorThread(command) as emulator:
        yield {"feed": emulator.ready["truth"], "control": emulator.ready["control"]}


def test_an_exported_orbit_is_a_start_value(tmp_path: Path) -> None:
    target = tmp_path / "leo.fmu"
    assert run_command_line("fmu", "export", "--orbit", "leo", "-o", str(target)) == (0, "", "")
    description = fmpy.read_model_description(str(target))
    (orbit,) = (each for each in description.modelVariables if each.name == "orbit")
    assert orbit.start == "leo"
    done = run_command_line("fmu", "export", "--orbit", "moon", "-o", str(target))
    assert done[0] != 0
    assert "leo" in done[2]


def test_the_descriptions_pass_the_schema_of_the_standard_and_the_rules_of_fmpy(
    fmu2: Path, fmu3: Path
) -> None:
    assert validate_fmu(str(fmu2)) == validate_fmu(str(fmu3)) == []


def test_the_errors_in_a_tumble_agree_with_the_stated_covariance_and_repeat_to_the_byte(
    fmu2: Path, fmu3: Path, tmp_path: Path
) -> None:
    inputs = tumble(15.0)
    with stepped_emulator(tmp_path, fmu3.parent / QUICK) as running:
        outputs = simulate(fmu3, inputs, **running)
    check_covariance(outputs, inputs)
    of_version_2 = simulate(fmu2, inputs[:51])
    assert of_version_2.tobytes() == outputs[:51].tobytes()
    assert of_version_2["valid"][-1]


def test_long_steps_and_a_late_begin_keep_the_stated_covariance(fmu3: Path, tmp_path: Path) -> None:
    motion = tumble(75.0)
    motion["time"] += 1000.0
    with stepped_emulator(tmp_path, fmu3.parent / QUICK) as running:
        check_covariance(simulate(fmu3, motion, step_s=5.0, **running), motion)


def check_covariance(outputs: np.ndarray, motion: np.ndarray) -> None:
    """The measurements agree with the motion at the times of their exposures, within the stated standard deviations."""
    _, newest = np.unique(outputs["frame"], return_index=True)
    rows = outputs[newest]
    rows = rows[rows["valid"].astype(bool)]
    assert len(rows) >= 13
    true = Slerp(motion["time"], Rotation.from_quat(np.array([motion[f"q_{i}"] for i in range(1, 5)]).T))(
        rows["exposure_s"]
    )
    measured = Rotation.from_quat(np.array([rows[f"measured_q{axis}"] for axis in "xyzw"]).T)
    errors = (measured * true.inv()).as_rotvec() * ARCSEC_PER_RAD
    sigma = np.array([rows["sigma_cross"], rows["sigma_cross"], rows["sigma_roll"]]).T
    squares = np.sum((errors / sigma) ** 2, axis=1)
    within = np.count_nonzero(squares < chi2.ppf(WITHIN_3_SIGMA, 3))
    assert within >= binom.ppf(CHANCE, len(rows), WITHIN_3_SIGMA)
    low, high = chi2.ppf((CHANCE / 2, 1.0 - CHANCE / 2), 3 * len(rows))
    assert low < squares.sum() < high
    assert rows["stars_matched"].min() > 5


# --- one step at a time ---


class Unit:
    """An instance of the FMU of version 3, with what it logs."""

    def __init__(self, path: Path, folder: Path, **parameters: object) -> None:
        description = fmpy.read_model_description(str(path))
        self.references = {each.name: each.valueReference for each in description.modelVariables}
        self.types = {each.name: each.type for each in description.modelVariables}
        self.messages: list[str] = []
        unpacked = fmpy.extract(str(path), unzipdir=str(folder / "fmu"))
        self.slave = FMU3Slave(
            guid=description.guid,
            unzipDirectory=unpacked,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="unit",
        )
        self.slave.instantiate(loggingOn=True, logMessage=self._log)
        self.time = 0.0
        for name, value in {"serial": "off", "can": "off", **parameters}.items():
            self.set(name, value)

    def _log(self, _environment: object, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append(message.decode())

    def begin(self) -> None:
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()

    def set(self, name: str, value: object) -> None:
        getattr(self.slave, f"set{self.types[name]}")([self.references[name]], [value])

    def get(self, name: str) -> object:
        (value,) = getattr(self.slave, f"get{self.types[name]}")([self.references[name]])
        return value.decode() if isinstance(value, bytes) else value

    def step(self, row: np.void) -> None:
        for name in row.dtype.names[1:]:
            self.set(name, row[name])
        self.slave.doStep(self.time, STEP_S)
        self.time += STEP_S


@contextlib.contextmanager
def unit_of(path: Path, folder: Path, **parameters: object) -> Iterator[Unit]:
    unit = Unit(path, folder, **parameters)
    try:
        yield unit
    finally:
        unit.slave.freeInstance()


@pytest.fixture(scope="module")
def tumbling(
    fmu3: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Unit, Iterator[np.void]]]:
    """A unit whose simulation has begun, and the rest of its motion; several tests step it on."""
    folder = tmp_path_factory.mktemp("tumbling")
    with stepped_emulator(folder, fmu3.parent / QUICK) as running, unit_of(fmu3, folder, **running) as unit:
        with refused("fmi3DoStep"):
            unit.slave.doStep(0.0, STEP_S)
        assert unit.messages == ["step at 0 s: the simulation begins when the initialization mode ends"]
        unit.begin()
        yield unit, iter(tumble(30.0))
        assert unit.get("valid")
        assert unit.get("time") == pytest.approx(unit.time)
        unit.slave.terminate()


def children(process: int, word: str) -> list[int]:
    """The children of a process that have a word in their command line."""
    pids = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(pid) for pid in pids if word in Path(f"/proc/{pid}/cmdline").read_text()]


def replies(step: Callable[[np.void], object], port: str) -> list[dict[str, object]]:
    """What an OBC reads on the serial line while a simulator steps."""
    with ObcClient.open(serial=port, timeout_s=PATIENCE_S) as obc:
        values = []
        for number, row in enumerate(tumble(6.0)):
            step(row)
            if number % 5 == 4:
                values.append(obc.telemetry("precise_attitude") | obc.telemetry("device_status"))
    return values


def test_an_obc_reads_the_same_after_a_reset_and_beside_a_simulator_that_speaks_to_the_feed(
    fmu3: Path, tmp_path: Path
) -> None:
    """At the end, the emulator dies, which ends the step."""
    before, by_fmu, outputs = children(os.getpid(), "serve"), [], []
    link = tmp_path / "port"
    with unit_of(fmu3, tmp_path, serial="auto", symlink=str(link)) as unit:
        for turn in range(2):
            if turn:
                unit.slave.reset()
                wait_until(lambda: not link.is_symlink())
                assert unit.get("frame") == 0
                unit.set("serial", "auto")  # a parameter can be set again
                unit.set("symlink", str(link))
            unit.begin()
            unit.time = 0.0
            assert unit.get("ready").startswith("ready truth=tcp:")
            by_fmu.append(replies(unit.step, str(link)))
            outputs.append([unit.get(name) for name in OUTPUTS])
        assert outputs[0] == outputs[1]
        assert outputs[0][OUTPUTS.index("valid")]
        dies(unit, before)
    with EmulatorThread(
        emulator_command(profile=str(fmu3.parent / QUICK), can="off", seed=1, settings=LOCK_STEP)
    ) as emulator:
        host, port = emulator.ready["truth"].removeprefix("tcp:").split(":")
        with socket.create_connection((host, int(port))) as feed, feed.makefile("rw") as lines:

            def step(row: np.void) -> None:
                values = [float(row[name]) for name in row.dtype.names]
                lines.write(json.dumps({"t": values[0], "q": values[1:5], "rate": values[5:]}) + "\n")
                lines.flush()
                assert json.loads(lines.readline())["ok"]

            assert [replies(step, emulator.ready["serial"])] * 2 == by_fmu
    assert by_fmu[0][-1]["valid"]


def dies(unit: Unit, before: list[int]) -> None:
    """An emulator that dies ends the step with a message; `before` are the processes of other FMUs."""
    row = tumble(unit.time)[-1]
    (process,) = set(children(os.getpid(), "serve")) - set(before)
    (emulator,) = children(process, "truth.lockstep")
    os.kill(emulator, signal.SIGKILL)
    time = unit.time
    with refused("fmi3DoStep"):
        unit.step(row)
    assert re.search(
        rf"inputs at {time:g} s: .*; the emulator ended (unexpectedly )?with status -9", unit.messages[-1]
    )
    with refused("fmi3DoStep"):
        unit.step(row)
    assert (
        unit.messages[-1] == f"step at {time:g} s: the simulation has ended; reset the FMU to begin another"
    )


def test_it_connects_to_an_emulator_that_runs_and_leaves_it_running(fmu3: Path, tmp_path: Path) -> None:
    with stepped_emulator(tmp_path, fmu3.parent / QUICK) as running:
        with unit_of(fmu3, tmp_path, **running) as unit:
            unit.begin()
            for row in tumble(2.5):
                unit.step(row)
            assert (unit.get("valid"), unit.get("mode")) == (True, "tracking")
            unit.slave.terminate()
        with socket.socket(socket.AF_UNIX) as channel:
            channel.connect(running["control"].removeprefix("unix:"))
            channel.sendall(b'{"do": "status"}\n')
            assert json.loads(channel.recv(4096))["ok"]


def test_signals_of_the_host_do_not_disturb_a_step(tumbling: tuple[Unit, Iterator[np.void]]) -> None:
    unit, motion = tumbling
    values = []
    before = signal.signal(signal.SIGALRM, lambda number, _frame: values.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 1e-3, 1e-3)
        for row in islice(motion, 100):
            unit.step(row)
            if len(values) > 20:  # Python handles those of a call as one, after it
                break
        assert unit.get("valid")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert len(values) > 20


def test_the_emulator_ends_with_a_host_that_dies(fmu3: Path, tmp_path: Path) -> None:
    link = tmp_path / "port"
    program = (
        "import os, signal, sys\nfrom pathlib import Path\n"
        f"from tests.process.test_fmu import Unit, tumble\n"
        f"unit = Unit(Path({str(fmu3)!r}), Path({str(tmp_path)!r}), serial='auto', symlink={str(link)!r})\n"
        f"unit.begin()\nunit.step(tumble(0.1)[0])\nassert Path({str(link)!r}).is_symlink()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    wait_until(lambda: not link.is_symlink())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"command": "/does/not/exist"}, "/does/not/exist does not start: No such file"),
        ({"profile": WRONG}, f"starhil does not start: .*{WRONG}: camera.widht: unknown key"),
        (
            {"feed": "127.0.0.1:1", "control": "unix:/none"},
            "no emulator at 127.0.0.1:1 and unix:/none: .*Connection refused",
        ),
    ],
)
def test_what_does_not_start_says_why(
    fmu3: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parameters: dict[str, object], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(WRONG).write_text("[run]\nworker = 'error_model'\n[camera]\nwidht = 5\n")
    with unit_of(fmu3, tmp_path, **parameters) as unit:
        with refused("fmi3ExitInitializationMode"):
            unit.begin()
        assert re.search(message, unit.messages[-1])


def test_the_process_rejects_the_values_of_another_version() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        command = [installed_command(), "fmu", "serve"]
        process = subprocess.Popen(command, stdin=theirs, stderr=subprocess.PIPE, text=True)
        ours.send(b"short")
        _, said = process.communicate(timeout=PATIENCE_S)
    assert said == "starhil: fmu serve: the FMU is of another version of starhil; export it again\n"
    assert process.returncode != 0


def test_a_text_that_is_too_long_is_rejected(fmu3: Path, tmp_path: Path) -> None:
    with unit_of(fmu3, tmp_path, symlink="x" * 4095) as unit:
        assert unit.get("symlink") == "x" * 4095
        with refused("fmi3SetString"):
            unit.set("symlink", "x" * 4096)
        assert unit.messages == ["a text is too long"]


def test_steps_that_do_not_follow_are_refused_and_the_simulation_goes_on(
    tumbling: tuple[Unit, Iterator[np.void]],
) -> None:
    unit, motion = tumbling
    with refused("fmi3ExitInitializationMode"):
        unit.slave.exitInitializationMode()
    for row in islice(motion, 15):
        unit.step(row)
    for size in (0.0, -STEP_S, 1e-10, float("nan"), float("inf")):
        with refused("fmi3DoStep"):
            unit.slave.doStep(unit.time, size)
        assert "its size is" in unit.messages[-1]
    for jump in (-1.5, -STEP_S, STEP_S):
        with refused("fmi3DoStep"):
            unit.slave.doStep(unit.time + jump, STEP_S)
        assert f"it must begin where the last one has ended, at {unit.time:g} s" in unit.messages[-1]
    for row in islice(motion, 10):
        unit.step(row)
    assert unit.get("valid")


def test_during_a_simulation_only_inputs_are_set(tumbling: tuple[Unit, Iterator[np.void]]) -> None:
    unit, motion = tumbling
    unit.step(next(motion))
    values = {
        "time": 1.0,
        "seed": 3,
        "check_rates": False,
        "profile": "demo",
        "valid": True,
        "mode": "standby",
    }
    for name, value in values.items():
        before = unit.get(name)
        with refused(f"fmi3Set{unit.types[name]}"):
            unit.set(name, value)
        assert unit.messages[-1].startswith(f"{name}: ")
        assert unit.get(name) == before
    unit.step(next(motion))


def test_a_start_is_a_time_before_the_simulation(
    tumbling: tuple[Unit, Iterator[np.void]], fmu3: Path, tmp_path: Path
) -> None:
    """A start that was given later moved the clock of the simulation."""
    unit, motion = tumbling
    unit.step(next(motion))
    with refused("fmi3EnterInitializationMode"):
        unit.slave.enterInitializationMode(startTime=1000.0)
    assert unit.messages[-1].startswith("start at 1000 s: ")
    assert unit.get("time") == pytest.approx(unit.time)
    unit.step(next(motion))
    with unit_of(fmu3, tmp_path) as other:
        for start in (float("nan"), float("inf")):
            with refused("fmi3EnterInitializationMode"):
                other.slave.enterInitializationMode(startTime=start)
        assert other.get("time") == 0.0


def test_a_variable_of_another_type_and_an_output_are_refused(fmu3: Path, tmp_path: Path) -> None:
    with unit_of(fmu3, tmp_path) as unit:
        for name, kind in (
            ("seed", "Float64"),
            ("q_1", "Int32"),
            ("valid", "Int32"),
            ("seed", "String"),
            ("mode", "Boolean"),
        ):
            reference = unit.references[name]
            with refused(f"fmi3Get{kind}"):
                getattr(unit.slave, f"get{kind}")([reference])
            assert unit.messages[-1] == f"value reference {reference}: not a variable of this type"
        with refused("fmi3SetFloat64"):
            unit.set("time", 1.0)  # nor is an output set before the simulation begins
        unit.set("seed", 2)


def test_a_quaternion_in_the_wrong_sense_ends_the_step_with_the_reason(fmu3: Path, tmp_path: Path) -> None:
    with unit_of(fmu3, tmp_path, convention="attitude") as unit:
        unit.begin()
        rows = tumble(1.0)
        with refused("fmi3DoStep"):
            list(map(unit.step, rows))
        assert "rate contradicts q" in unit.messages[-1]
        assert "truth.convention" in unit.messages[-1]


def test_without_a_compiler_the_export_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("starhil.emulator.cli.fmu.export.shutil.which", lambda _name: None)
    status, _, said = run_command_line("fmu", "export", "-o", str(tmp_path / "x.fmu"))
    assert status == 2
    assert said.splitlines() == [
        "starhil: fmu export: needs a C compiler (cc, gcc or clang); as root on Debian: apt-get install gcc libc6-dev"
    ]


def test_the_version_2_binary_reports_to_its_callback(fmu2: Path, tmp_path: Path) -> None:
    description = fmpy.read_model_description(str(fmu2))
    references = {each.name: each.valueReference for each in description.modelVariables}
    slave = FMU2Slave(
        guid=description.guid, unzipDirectory=fmpy.extract(str(fmu2), unzipdir=str(tmp_path / "fmu")),
        modelIdentifier=description.coSimulation.modelIdentifier, instanceName="unit",
    )  # fmt: skip
    messages = []
    callbacks = fmpy.fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(lambda *arguments: messages.append(arguments))
    callbacks.allocateMemory = fmpy.fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmpy.fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
    slave.instantiate(callbacks=callbacks, loggingOn=True)
    slave.setString([references["command"]], ["/does/not/exist"])
    slave.enterInitializationMode()
    with refused("fmi2ExitInitializationMode"):
        slave.exitInitializationMode()
    ((_environment, instance, status, category, text),) = messages
    assert (instance, status, category, text) == (b"unit", ERROR, b"logStatusError", b"%s")
    slave.freeInstance()


def test_the_program_of_the_docs_prints_what_they_show(fmu3: Path, tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "fmu.md").read_text(encoding="utf-8")
    program, shown = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", page, re.DOTALL).groups()
    shutil.copy(fmu3, tmp_path / "startracker.fmu")
    printed = io.StringIO()
    with contextlib.chdir(tmp_path), contextlib.redirect_stdout(printed):
        exec(compile(program, "fmu.md", "exec"), {})
    assert printed.getvalue().splitlines()[-1:] == shown.splitlines()
