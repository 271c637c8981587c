"""`starhil run` as a separate process: ready line, end, bad input, and the same bytes for the same run."""

import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time
import tty
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from starhil.protocol.messages import Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from tests.emulator.cli.command_line import log_lines, run_command_line
from tests.process.conftest import NO_IMAGES_OPTIONS
from tests.protocol.serial.composed_links import CUBESTAR
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.process

ACCURACY_ARCSEC = 20.0
ICD = load_unit()


class Emulator:
    """A running emulator with its control channel and serial line."""

    def __init__(self, *arguments: str) -> None:
        signals = (  # as under a script that starts it in the background, but not under nohup
            "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); signal.signal(signal.SIGINT, signal.SIG_IGN)"
        )
        command = [
            sys.executable,
            "-c",
            f"{signals}; from starhil.emulator.cli.app import main; main()",
            "run",
            "ideal",
        ]
        self.process = subprocess.Popen(
            [*command, "--can", "off", "--control", "auto", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert select.select([self.process.stdout], [], [], PATIENCE_S)[0], "no ready line"
        line = self.process.stdout.readline()
        assert line.startswith("ready "), self.process.stderr.read()
        self.ready = dict(word.split("=", 1) for word in line.split()[1:])
        self.control = socket.socket(socket.AF_UNIX)
        self.control.settimeout(PATIENCE_S)
        self.control.connect(self.ready["control"].removeprefix("unix:"))
        self.lines = self.control.makefile("rw")
        self.fd = os.open(self.ready["serial"], os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)

    def do(self, action: str, **values):
        self.lines.write(json.dumps({"do": action, **values}) + "\n")
        self.lines.flush()
        answer = json.loads(self.lines.readline())
        assert answer["ok"], answer
        return answer

    def ask(self, identifier: int, data: bytes = b""):
        """Send a request in dialect a; return raw bytes and the reply."""
        request = Request.of(identifier, data)
        host = CUBESTAR.host(Dialect.A)
        os.write(self.fd, host.request(request))
        raw, replies = b"", []
        while not replies:
            assert select.select([self.fd], [], [], PATIENCE_S)[0], "no reply"
            data = os.read(self.fd, 4096)
            raw += data
            replies = host.feed(data, 0.0)
        return raw, replies[0]

    def read(self, name: str):
        row = ICD.telemetry[name]
        return row.decode(self.ask(row.id)[1].data)

    def command(self, name: str, **values) -> int:
        row = ICD.telecommands[name]
        return int(self.ask(row.id, row.encode(values))[1].code)

    def end(self, number=signal.SIGTERM) -> tuple[int, list[str]]:
        os.close(self.fd)
        self.control.close()
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, log_lines(errors)


SEEDED = ("--clock", "stepped", "--seed", "5", "--dialect", "a")


def first_bytes(emulator: Emulator) -> bytes:
    """Let an emulator boot and see the sky; return every row four times."""
    emulator.do("step", seconds=1.0)
    out = bytearray(emulator.ask(96, b"\x02")[0])
    for _ in range(4):
        emulator.do("step", seconds=0.9)
        for row in ICD.telemetry.values():
            out += emulator.ask(row.id)[0]
    return bytes(out)


@pytest.fixture(scope="module")
def stepped(tmp_path_factory):
    """One emulator on the stepped clock for several tests, of which the first bytes are kept."""
    link = tmp_path_factory.mktemp("link") / "tty"
    emulator = Emulator(*SEEDED, "--symlink", str(link))
    emulator.link = link
    emulator.first_bytes = first_bytes(emulator)
    yield emulator
    assert emulator.end() == (0, [])
    assert not link.is_symlink()


def test_the_ready_line_names_the_dialect_that_replies_have(stepped):
    assert stepped.ready["dialect"] == "a"
    assert stepped.ask(128)[0][:3] == b"\x1f\x7f\x80"


def test_the_process_that_answers_the_bus_loads_no_numerical_library_but_numpy(stepped):
    files = Path(f"/proc/{stepped.process.pid}/maps").read_text()
    assert "/numpy/" in files
    assert not [name for name in ("llvmlite", "numba", "scipy", "cv2") if f"/{name}/" in files]


def test_a_symlink_leads_to_the_port(stepped):
    assert stepped.ready["serial"] == str(stepped.link)
    assert stepped.link.is_symlink()


def test_the_ready_line_names_profile_and_unit_with_its_version(stepped):
    chosen = {key: stepped.ready[key] for key in ("unit", "unit_version", "profile")}
    assert chosen == {"unit": "cubestar", "unit_version": ICD.version, "profile": "ideal"}


def test_the_real_sky_gives_the_true_attitude(stepped):
    stepped.do("clear_faults")
    stepped.do(
        "set_truth",
        truth={
            "kind": "rate",
            "attitude": {"ra_deg": 210.0, "dec_deg": 55.0},
            "rate_deg_s": [0.1, -0.2, 0.3],
        },
    )
    assert stepped.command("set_mode", mode="lost_in_space") == 0
    stepped.do("step", seconds=5.0)
    values = stepped.read("precise_attitude")
    truth = stepped.do("truth", unix_s=values["time_of_exposure"])
    measured = Attitude(np.array([values[f"q_{axis}"] for axis in "xyzw"]))
    error = measured.error_to(Attitude(np.array(truth["quaternion_xyzw"])))
    assert values["valid"]
    assert values["tracking"]
    assert error.total_arcsec < ACCURACY_ARCSEC
    assert [values[f"rate_{axis}"] for axis in "xyz"] == pytest.approx([0.1, -0.2, 0.3], abs=0.01)
    (frame,) = stepped.do("frames", count=1)["frames"]
    assert frame["frame"] == values["frame_counter"]
    assert frame["total_arcsec"] == pytest.approx(error.total_arcsec, abs=0.1)


def test_a_downloaded_image_is_the_exposed_one(stepped):
    stepped.command("save_image", image_size="size_128")
    stepped.do("step", seconds=2.0)
    assert stepped.read("image_status")["percent"] == 100
    assert stepped.command("init_image_download", image_size="size_128") == 0
    pixels = b""
    for frame in range(128):
        assert stepped.command("advance_image_download", next_frame=frame) == 0
        pixels += stepped.read("image_frame")["data"]
    image = np.frombuffer(pixels, np.uint8).reshape(128, 128)
    assert image.max() > image[:100, :100].mean() + 3.0  # stars stand out of the background
    assert not image[118:].any()  # below the 937 rows there is nothing
    assert not image[:, 118:].any()


def test_a_new_focal_length_ruins_the_attitude_until_it_is_right_again(stepped):
    stepped.command("set_mode", mode="standby")
    stepped.command("set_parameter", parameter=15, value=1000.0)
    stepped.command("set_mode", mode="lost_in_space")
    stepped.do("step", seconds=3.0)
    values = stepped.read("precise_attitude")
    assert not values["valid"]
    assert values["reason"] in {"no_match", "residual", "too_few_stars", "ambiguous"}
    stepped.command("default_parameters")
    stepped.do("step", seconds=3.0)
    assert stepped.read("precise_attitude")["valid"]


def test_a_covered_field_clears_the_validity_and_false_stars_do_not(stepped):
    stepped.command("set_mode", mode="lost_in_space")
    stepped.do("set_truth", truth={"kind": "fixed"})
    stepped.do("fault", optical={"blocked_share": 1.0})
    stepped.do("step", seconds=2.0)
    values = stepped.read("precise_attitude")
    assert not values["valid"]
    assert values["reason"] == "too_few_stars"
    stepped.do("fault", optical={"false_stars": 15, "blocked_share": 0.3})
    stepped.do("step", seconds=4.0)
    values = stepped.read("precise_attitude")
    measured = Attitude(np.array([values[f"q_{axis}"] for axis in "xyzw"]))
    truth = Attitude(np.array(stepped.do("truth")["quaternion_xyzw"]))
    assert values["valid"]
    assert measured.error_to(truth).total_arcsec < ACCURACY_ARCSEC
    stepped.do("clear_faults")
    stepped.do("step", seconds=2.0)
    assert stepped.read("precise_attitude")["valid"]


def test_the_real_clock_runs_by_itself_and_ends_on_sigint(tmp_path):
    log = tmp_path / "truth.csv"
    emulator = Emulator(
        "--truth-log", str(log), "--set", "parameters.update_rate=10", "--set", "links.serial.dialect=a",
        *NO_IMAGES_OPTIONS,
    )  # fmt: skip
    assert emulator.read("device_status")["mode"] == "standby"
    assert emulator.command("set_mode", mode="lost_in_space") == 0
    while emulator.read("device_status")["frames_captured"] < 5:
        select.select([], [], [], 0.05)
    code, errors = emulator.end(signal.SIGINT)
    assert (code, errors) == (0, [])
    lines = log.read_text().splitlines()
    assert len(lines) >= 6
    names, row = lines[0].split(","), lines[-1].split(",")
    values = dict(zip(names, row, strict=True))
    assert math.isfinite(float(values["cross_boresight_arcsec"]))


def test_a_signal_to_the_worker_too_disturbs_no_image(stepped):
    """Nor is it reported: what `stepped` has said is seen at its end."""
    children = Path(f"/proc/{stepped.process.pid}/task/{stepped.process.pid}/children").read_text().split()
    assert children
    for child in children:
        os.kill(int(child), signal.SIGTERM)
    assert stepped.command("set_mode", mode="lost_in_space") == 0
    stepped.do("step", seconds=3.0)  # waits for frames, which a worker that has ended no longer makes


def is_running(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_two_runs_of_one_seed_give_the_same_bytes_and_a_killed_one_leaves_no_worker_and_its_place(
    stepped, tmp_path
):
    """A hangup ends the last one in good order, as SIGTERM does that of `stepped`, and SIGINT that of the real clock."""
    link = tmp_path / "tty"
    arguments = (*SEEDED, "--symlink", str(link), "--state-dir", str(tmp_path))
    emulator = Emulator(*arguments)
    assert len(stepped.first_bytes) > 2000
    assert first_bytes(emulator) == stepped.first_bytes
    pid = emulator.process.pid
    (worker,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    code, _ = emulator.end(signal.SIGKILL)
    assert code == -signal.SIGKILL
    wait_until(lambda: not is_running(worker))
    assert link.is_symlink()
    emulator = Emulator(*arguments, *NO_IMAGES_OPTIONS)
    assert emulator.read("boot_status")["boot_count"] == 2
    assert emulator.end(signal.SIGHUP) == (0, [])
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no_such_profile"], "no_such_profile"),
        (["--serial", "off"], "--control auto"),
        (["--set", "sensor.apperture_m=0.01"], "apperture_m"),
        (["--serial", "/dev/no_such_tty"], "/dev/no_such_tty"),
        (["--state-dir", "/proc/none"], "/proc/none"),
        (["--set", "truth.kind=file", "--set", "truth.path=gone.csv"], "gone.csv"),
    ],
)
def test_bad_input_ends_in_one_line_and_status_2(arguments, said):
    check_rejected([*arguments, *NO_IMAGES_OPTIONS], said)


def test_a_catalogue_that_the_pipeline_cannot_read_ends_in_one_line_and_status_2():
    check_rejected(["--set", "catalog.path=/no/such/file"], "/no/such/file")


def test_a_unit_that_gets_the_sensor_of_the_default_profile_is_noted():
    words = ("--can", "off", "--serial", "/dev/no_such_tty", "--unit", "nos3", *NO_IMAGES_OPTIONS)
    assert "note:" not in run_command_line("run", "ideal", *words)[2]
    status, _, err = run_command_line("run", *words)
    note, error = log_lines(err)
    assert note == (
        "note: camera, sensor and parameters of the unit nos3 are those of the profile cubestar; name a profile to change them "
        "(starhil docs profile)"
    )
    assert (status, error[:9]) == (2, "starhil: ")


def test_attitudes_that_are_valid_whatever_their_uncertainty_are_noted():
    words = (
        "--can",
        "off",
        "--serial",
        "/dev/no_such_tty",
        "--set",
        "run.algorithm=rsi",
        "--set",
        "run.worker=thread",
        "--set",
    )
    assert "note:" not in run_command_line("run", *words, "identifier.refinement=true")[2]
    note, _ = log_lines(run_command_line("run", *words, "identifier.refinement=false")[2])
    assert note == (
        "note: identifier.refinement=false is for experiments: attitudes are valid whatever their stated uncertainty, and most are "
        "off by degrees (starhil docs identification)"
    )


def check_rejected(arguments, message):
    status, out, err = run_command_line("run", "--can", "off", *arguments)
    assert (status, out) == (2, ""), err
    (line,) = log_lines(err)
    assert line.startswith("starhil: ")
    assert message in line


def test_signals_to_an_emulator_that_ends_do_not_change_its_status():
    """Sent until the process is gone: one in its last tenth of a second ended it by the signal."""
    emulator = Emulator("--clock", "stepped", *NO_IMAGES_OPTIONS)
    emulator.do("quit")
    os.close(emulator.fd)
    emulator.control.close()
    deadline = time.monotonic() + PATIENCE_S
    numbers = cycle((signal.SIGTERM, signal.SIGINT, signal.SIGHUP))
    while emulator.process.poll() is None and time.monotonic() < deadline:
        emulator.process.send_signal(next(numbers))
        time.sleep(0.001)
    assert (emulator.process.wait(timeout=1.0), log_lines(emulator.process.stderr.read())) == (0, [])
