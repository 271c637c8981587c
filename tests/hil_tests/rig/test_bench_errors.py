"""The bench's own failures: a process that does not start or end, a link that is not there, and interruption."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from starhil.hil_tests.client.canopen_link import CanopenHostLink
from starhil.hil_tests.client.raw_traffic import pattern
from starhil.hil_tests.errors import BenchError, EmulatorProcessError
from starhil.hil_tests.rig import emulator_process
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, installed_command, parse_ready_line
from starhil.hil_tests.rig.interruption import Interrupted, interruptible
from starhil.hil_tests.rig.rig import LinkOptions, Rig
from starhil.hil_tests.rig.truth_log import QUATERNION_COLUMNS, TIME_COLUMN, TruthLogReader
from starhil.hil_tests.timing.realtime import set_realtime_priority
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import ReplyKind, Request, RequestKind
from starhil.protocol.unit import load_unit
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.long

ICD = load_unit()
READY = "print('Hello', flush=True); print('ready unit=sagitta serial=/dev/x', flush=True)"
FOREVER = "import time; time.sleep(600)"


def emulator(*lines: str, within_s: float = 30.0) -> EmulatorProcess:
    """Return a Python program in the emulator's place."""
    return EmulatorProcess([sys.executable, "-c", "\n".join(lines)], ready_within_s=within_s)


# -- the emulator as a process -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["import sys; sys.exit('no sky today')"], "ended with status 1 before it was ready: no sky today"),
        (["import sys; [print(n, file=sys.stderr) for n in range(9)]"], "status 0 before it was ready: 4 | 5 | 6 | 7 | 8"),
        (["import sys; print('starhil: a', 'log', 'starhil: b', sep='\\n', file=sys.stderr); sys.exit(2)"], "a; b"),
        ([FOREVER], "the emulator was not ready within 0.5 s"),
    ],
)  # fmt: skip
def test_an_emulator_that_does_not_become_ready_is_reported_with_its_last_errors(lines, message):
    process = emulator(*lines, within_s=0.5 if lines == [FOREVER] else 30.0)
    with pytest.raises(EmulatorProcessError) as caught:
        process.start()
    assert message in str(caught.value)
    assert not process.running


def test_a_program_that_is_not_there_and_a_process_that_was_not_started_are_reported():
    with pytest.raises(EmulatorProcessError, match=r"/no/such/program: cannot be started: No such file"):
        EmulatorProcess(["/no/such/program"]).start()
    process = emulator(FOREVER)
    assert not process.running
    with pytest.raises(EmulatorProcessError, match="has not been started"):
        process.stop()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["import signal, sys; signal.signal(15, lambda *_: sys.exit('spilt'))", READY, FOREVER], "the emulator ended with status 1: spilt"),
        (["import signal; signal.signal(15, signal.SIG_IGN)", READY, FOREVER], "the emulator did not end within 0.3 s"),
        ([READY], "the emulator ended unexpectedly with status 0"),
    ],
)  # fmt: skip
def test_an_emulator_that_does_not_end_well_is_reported(monkeypatch, lines, message):
    process = emulator(*lines).start()
    assert process.ready == {"unit": "sagitta", "serial": "/dev/x"}
    if "SIG_IGN" in lines[0]:
        monkeypatch.setattr(emulator_process, "STOP_WITHIN_S", 0.3)
    if lines == [READY]:
        process.process.wait()
    with pytest.raises(EmulatorProcessError, match=message):
        process.stop()
    assert not process.running


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_restarted_emulator_is_another_process_with_the_same_command(number):
    handler = (
        "import os, signal; signal.signal(15, lambda *_: os._exit(0))"  # an exception could be lost in it
    )
    with emulator(handler, READY, FOREVER) as process:
        first = process.process.pid
        assert process.memory_bytes() > 2**20
        process.restart(number)
        assert process.running
        assert process.process.pid != first


def test_an_error_within_the_run_kills_the_emulator():
    process = emulator("import signal; signal.signal(15, signal.SIG_IGN)", READY, FOREVER)
    with pytest.raises(ZeroDivisionError), process:
        _ = 1 / 0
    assert process.process.returncode == -signal.SIGKILL


def test_progress_of_a_slow_start_is_shown_and_is_no_error(capfd):
    show = "import sys; print('starting: 3 of 9', file=sys.stderr); print('odd', file=sys.stderr, flush=True)"
    process = emulator(show, READY, FOREVER).start()
    process.kill()
    assert process.errors == ["odd"]
    assert capfd.readouterr().err == "starting: 3 of 9\n"


@pytest.mark.parametrize("line", ["", "  \n", "started serial=x"])
def test_another_line_is_no_ready_line(line):
    with pytest.raises(EmulatorProcessError, match="not a ready line"):
        parse_ready_line(line)


def test_bench_and_emulator_must_have_the_same_unit():
    process = emulator(FOREVER)
    process.check_unit(None)
    process.ready = {"unit": "/home/x/my%20unit"}
    process.check_unit("my_unit")
    with pytest.raises(
        BenchError, match=r"the profile's unit is /home/x/my unit: add --unit /home/x/my unit"
    ):
        process.check_unit(None)


def test_the_command_is_beside_the_interpreter_or_on_path(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(EmulatorProcessError, match=r"neither beside .* nor on PATH"):
        installed_command()
    for folder in (tmp_path, tmp_path / "bin"):
        folder.mkdir(exist_ok=True)
        (folder / "starhil").write_text("#!/bin/sh\n")
        (folder / "starhil").chmod(0o755)
        assert installed_command() == str(folder / "starhil")


def with_parent(parent: int, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "starhil.hil_tests.rig.end_with_parent", str(parent), *command],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip


@pytest.mark.process
def test_a_command_runs_with_its_parent_and_ends_at_once_if_that_has_ended():
    assert with_parent(os.getpid(), "/bin/echo", "alive").stdout == "alive\n"
    assert with_parent(1 if os.getppid() != 1 else 2, "/bin/sleep", "600").returncode == -signal.SIGTERM
    failed = with_parent(os.getpid(), "/no/such/program")
    assert (failed.returncode, failed.stderr) == (
        1,
        "/no/such/program: cannot be started: No such file or directory\n",
    )


# -- interruption, priority, links ---------------------------------------------------------------------------------------


def test_the_first_signal_interrupts_and_further_ones_are_ignored():
    before = signal.getsignal(signal.SIGTERM)
    hangup = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored under nohup

    def send(number):
        os.kill(os.getpid(), number)
        signal.pause()

    with interruptible(), pytest.raises(Interrupted, match="interrupted by SIGHUP") as caught:
        send(signal.SIGHUP)
    assert caught.value.exit_status == 129
    with interruptible():
        with pytest.raises(Interrupted):
            send(signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)  # would end pytest
    assert signal.getsignal(signal.SIGTERM) is before
    signal.signal(signal.SIGHUP, hangup)


def test_signals_stay_as_they_are_in_other_threads_and_where_they_are_ignored():
    handlers = []

    def look():
        with interruptible():
            handlers.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGTERM)]
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_priority_that_is_not_permitted_is_reported(monkeypatch):
    def refuse(*_arguments):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(BenchError, match="real-time priority: Operation not permitted; run it as root"):
        set_realtime_priority()


def test_a_link_that_the_emulator_did_not_open_is_reported():
    process = emulator("import signal, sys; signal.signal(15, lambda *_: sys.exit(0))", READY, FOREVER)
    rig = Rig(LinkOptions(serial="auto", can="auto"), ICD, emulator=process)
    with rig, pytest.raises(BenchError, match="the emulator did not open a can link; its ready line has"):
        rig.client("can")


@pytest.mark.parametrize("text", ["1F 7", "XY", "123#0", "#00"])
def test_a_pattern_is_bytes_or_a_frame(text):
    with pytest.raises(BenchError, match="not bytes in hexadecimal or a CAN frame"):
        pattern(text)


def test_only_the_response_of_its_node_continues_a_transfer_which_a_time_out_aborts():
    link, sent = CanopenHostLink(ICD, "virtual:x"), []
    link.send = lambda frame: sent.append((frame.id, frame.data.hex()))
    row = next(row for row in ICD.telemetry.values() if row.size == 1)
    unknown = next(number for number in range(128, 256) if ICD.row(number) is None)
    link.reset_receiver()
    assert sent == []
    with pytest.raises(BenchError, match=f"request {unknown} is not in the object dictionary"):
        link.request(Request(RequestKind.TELEMETRY, unknown))
    link.request(Request(RequestKind.TELEMETRY, row.id))
    response = bytes.fromhex("4f0020") + bytes((row.id, 5, 0, 0, 0))
    for foreign in (CanFrame(0x581, response, extended=False), CanFrame(0x5AC, response, extended=True)):
        assert link.feed(foreign, 0.0) == []
    assert link.busy
    (reply,) = link.feed(CanFrame(0x5AC, response, extended=False), 0.0)
    assert (reply.kind, reply.data, link.busy) == (ReplyKind.TELEMETRY, b"\5", False)
    link.request(Request(RequestKind.TELEMETRY, row.id))
    link.reset_receiver()
    assert sent[-1] == (0x62C, "8000000000000405")
    assert not link.busy


# -- the truth log -------------------------------------------------------------------------------------------------------

HEADER = ",".join((TIME_COLUMN, *QUATERNION_COLUMNS)) + "\n"


@pytest.mark.parametrize(
    ("text", "time_s", "expected"),
    [
        ("10,0,0,0,1\n20,1,0,0,0\n", 9.9996, (0.0, 0.0, 0.0, 1.0)),  # telemetry is rounded
        ("10,0,0,0,1\n20,1,0,0,0\n", 20.0004, (1.0, 0.0, 0.0, 0.0)),
        ("10,0,0,0,1\n20,1,0,0,0\n", 15.0, (0.5**0.5, 0.0, 0.0, 0.5**0.5)),
        ("10,0,0,0,1\n20,1,0,", 10.0, (0.0, 0.0, 0.0, 1.0)),  # the last line is still being written
    ],
)
def test_the_truth_is_interpolated_within_the_log(tmp_path, text, time_s, expected):
    path = tmp_path / "truth.csv"
    path.write_text(HEADER + text)
    reader = TruthLogReader(path)
    assert reader.at(time_s) == pytest.approx(expected)
    path.unlink()
    assert reader.at(time_s) == pytest.approx(expected)  # it is read again only for a time beyond it
