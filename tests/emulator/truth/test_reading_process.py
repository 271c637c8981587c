"""Files of truth that others have made: neither their size nor what reads them concerns the run."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.threads import in_thread
from starhil.emulator.truth import reading_process
from starhil.emulator.truth.file import read_orbit_file, read_truth_file
from starhil.emulator.truth.reading_process import (
    AT_ONCE_BYTES,
    LOOK_S,
    MAX_PROCESSES,
    NICER,
    NICEST,
    read_orbit,
    read_truth,
)
from starhil.hil_tests.rig.emulator_process import installed_command
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.truth.test_standard_files import aem
from tests.waiting import until, wait_until

pytestmark = pytest.mark.long

CSV = "t,qx,qy,qz,qw,wx_deg_s,wy_deg_s,wz_deg_s,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s\n" + "".join(
    f"{t},0,0,{np.sin(0.01 * t)},{np.cos(0.01 * t)},0,0,{np.degrees(0.02)},7e6,{t},0,0,7500,0\n"
    for t in range(20)
)
DATES = aem(
    "QUATERNION", [f"2026-03-20T12:00:{t:02d}.0 0 0 {np.sin(0.01 * t)} {np.cos(0.01 * t)}" for t in range(20)]
)
OEM = """CCSDS_OEM_VERS = 2.0
META_START
OBJECT_NAME = X
CENTER_NAME = EARTH
REF_FRAME = EME2000
TIME_SYSTEM = UTC
META_STOP
2026-01-01T00:00:00 7000 0 0 0 7.5 0
2026-01-01T00:01:00 6990 450 0 -0.5 7.49 0
META_START
OBJECT_NAME = X
CENTER_NAME = EARTH
REF_FRAME = EME2000
TIME_SYSTEM = UTC
META_STOP
2026-01-01T01:00:00 7000 0 0 0 7.5 0
2026-01-01T01:01:00 6990 450 0 -0.5 7.49 0
"""


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read every file in another process."""
    monkeypatch.setattr(reading_process, "AT_ONCE_BYTES", -1)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("text", [CSV, DATES], ids=["rates and orbit", "dates"])
def test_another_process_reads_the_same_truth_with_the_same_warnings(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / "truth", text)
    with caplog.at_level(logging.WARNING, logger="starhil.truth"):
        here, there = read_truth_file(path), read_truth(path)
    warning = f"truth file {path}: has no rates, so the sense of its attitudes cannot be checked; compare one of them with its source"
    assert [record.getMessage() for record in caplog.records] == ([] if text is CSV else 2 * [warning])
    assert [*here.spans] == [*there.spans]
    assert (here.smooth, here.start_unix_s) == (there.smooth, there.start_unix_s)
    for t in (-1.0, 0.0, 3.3, 7.0, 19.0, 1000.0):
        one, other = here.state(t), there.state(t)
        assert np.abs(one.attitude.quaternion_xyzw - other.attitude.quaternion_xyzw).max() < 1e-15
        assert (one.rate_rad_s == other.rate_rad_s).all()
        assert (one.status, one.unix_s) == (other.status, other.unix_s)
        assert (one.orbit is None) == (other.orbit is None)
        if one.orbit is not None and other.orbit is not None:
            assert (one.orbit.position_m == other.orbit.position_m).all()
            assert (one.orbit.velocity_m_s == other.orbit.velocity_m_s).all()


@pytest.mark.usefixtures("apart")
def test_another_process_reads_the_same_orbit(tmp_path: Path) -> None:
    path = write(tmp_path / "orbit", OEM)
    here, there = read_orbit_file(path), read_orbit(path)
    for unix_s in (1_767_225_600.0, 1_767_225_630.0, 1_767_229_200.0):
        assert (here.state(unix_s).position_m == there.state(unix_s).position_m).all()
        assert (here.state(unix_s).velocity_m_s == there.state(unix_s).velocity_m_s).all()
    with pytest.raises(EmulatorError, match="do not include the date"):
        there.state(1_767_225_700.0)


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("text", ["KPL/MK", "t,qx,qy,qz,qw\n0,0,0,0,1\n0,0,0,0,1\n"])
def test_another_process_rejects_the_same_files_for_the_same_reason(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "truth", text)
    with pytest.raises(EmulatorError) as here:
        read_truth_file(path)
    with pytest.raises(EmulatorError) as there:
        read_truth(path)
    assert here.value.args == there.value.args


def test_a_small_text_is_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", None)
    assert len(read_truth(write(tmp_path / "truth", CSV)).attitudes) == 20


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL])
def test_the_end_of_what_reads_a_file_is_an_error_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """As by a defect of SPICE, or for lack of memory."""
    path = write(tmp_path / "truth", "KPL/MK\n")
    end = f"import os; os.kill(os.getpid(), {int(number)})"
    start = subprocess.Popen

    def dying(_command: list[str], **options: object) -> object:
        return start([sys.executable, "-c", end], **options)

    monkeypatch.setattr(subprocess, "Popen", dying)
    with pytest.raises(
        EmulatorError, match=f"cannot be read .the process that reads it has ended by {number.name}.$"
    ):
        read_truth(path)


def test_repeated_columns_are_found_in_a_time_that_grows_with_their_number(tmp_path: Path) -> None:
    path = write(tmp_path / "truth", "t,qx,qy,qz,qw" + ",t" * 300_000 + "\n")
    begin_s = time.process_time()
    with pytest.raises(EmulatorError, match="column t appears twice"):
        read_truth_file(path)
    assert time.process_time() - begin_s < 2.0  # the square of the number takes 40 s


@pytest.mark.parametrize("cell", ["1e300", "nan", "inf", "-1e12", "x"])
def test_a_log_whose_times_are_no_dates_is_none(tmp_path: Path, cell: str) -> None:
    path = write(
        tmp_path / "log.csv",
        f"time_of_exposure_s,run_time_s,measured_qx,measured_qy,measured_qz,measured_qw\n{cell},0,0,0,0,1\n",
    )
    status, _, err = run_command_line(
        "truth", "convert", str(path), "--measured", "-o", str(tmp_path / "a.aem")
    )
    assert (status, err) == (
        2,
        f"starhil: {path}: not a truth log with rows; of other files without dates, give --date\n",
    )


ENDED_MEANWHILE = contextlib.suppress(FileNotFoundError, ProcessLookupError)
"""Threads and processes do while they are looked at."""


def readers_of(parent: int) -> list[int]:
    """Return the processes that read a file for another."""
    children: list[str] = []
    for task in Path(f"/proc/{parent}/task").iterdir():
        with ENDED_MEANWHILE:
            children += (task / "children").read_text().split()
    readers = []
    for child in children:
        with ENDED_MEANWHILE:
            if b"reading_process" in Path(f"/proc/{child}/cmdline").read_bytes():
                readers.append(int(child))
    return readers


@pytest.mark.process
def test_a_signal_ends_a_start_that_reads_a_long_file(tmp_path: Path) -> None:
    rows = "".join(f"{t},0,0,0,1\n" for t in range(300_000))  # ten seconds of reading
    path = write(tmp_path / "long.csv", f"t,qx,qy,qz,qw\n{rows}")
    assert path.stat().st_size > AT_ONCE_BYTES
    settings = ["--set", "truth.kind=file", "--set", f"truth.path={path}", "--set", "run.worker=error_model"]
    command = [installed_command(), "run", "ideal", "--can", "off", *settings]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: readers_of(process.pid))
        found = readers_of(process.pid)
        process.send_signal(signal.SIGTERM)
        assert (process.communicate()[0], process.returncode) == (b"", 0)
    wait_until(lambda: not any(map(is_alive, found)))


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_file_that_has_nothing_yet_is_rejected_without_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The truth could not be set again as long as nobody wrote to such a file, which in /proc counts as a regular one."""
    path = tmp_path / "kmsg"
    os.mkfifo(path)
    monkeypatch.setattr(stat, "S_ISREG", lambda _mode: True)
    writer = os.open(path, os.O_RDWR)
    try:
        with pytest.raises(EmulatorError, match="Resource temporarily unavailable"):
            read_truth(path)
    finally:
        os.close(writer)


def meta_kernel_of_a_pipe(folder: Path) -> Path:
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    return write(folder / "meta", f"KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( '{pipe}' )\n")


@pytest.mark.process
def test_a_file_of_which_nothing_arrives_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipe was waited for during an hour."""
    monkeypatch.setattr(reading_process, "SILENT_S", 1)
    with pytest.raises(
        EmulatorError, match=r"cannot be read .nothing of it has arrived for 1 s; does it name a pipe"
    ):
        read_truth(meta_kernel_of_a_pipe(tmp_path))


def test_a_folder_whose_server_does_not_answer_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = threading.Event()
    monkeypatch.setattr(reading_process, "SILENT_S", 0.2)
    monkeypatch.setattr(reading_process, "_is_small_text", lambda _path: answer.wait())
    try:
        with pytest.raises(EmulatorError, match=r"orbit file .*: cannot be read .nothing of it has arrived"):
            read_orbit(tmp_path / "orbit")
    finally:
        answer.set()


ENDLESS = "import json, sys, time\nwhile time.monotonic() < {until}: json.dumps(0)\nprint(json.dumps({{'problems': ['read']}}))"


@pytest.mark.process
def test_a_file_that_is_still_being_read_is_waited_for_up_to_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, start = write(tmp_path / "truth", "KPL/MK\n"), subprocess.Popen

    def busy(_command: list[str], **options: object) -> object:
        return start([sys.executable, "-c", ENDLESS.format(until=time.monotonic() + 3)], **options)

    monkeypatch.setattr(subprocess, "Popen", busy)
    monkeypatch.setattr(reading_process, "SILENT_S", 1)
    with pytest.raises(EmulatorError, match=r"^read$"):
        read_truth(path)
    monkeypatch.setattr(reading_process, "LONGEST_S", 1)
    with pytest.raises(EmulatorError, match=r"cannot be read .it takes longer than 1 s."):
        read_truth(path)


@pytest.mark.process
def test_what_reads_a_file_yields_to_the_run_and_ends_when_nobody_waits(tmp_path: Path) -> None:
    """The file of a truth that was set meanwhile delayed replies tenfold, and was read to its end."""

    async def scenario() -> None:
        reading = asyncio.create_task(in_thread(read_truth, meta_kernel_of_a_pipe(tmp_path)))
        await until(lambda: readers_of(os.getpid()))
        (reader,) = readers_of(os.getpid())
        niceness = min(NICEST, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
        await until(lambda: os.getpriority(os.PRIO_PROCESS, reader) == niceness)
        reading.cancel()
        await until(lambda: not is_alive(reader))

    asyncio.run(scenario())


@pytest.mark.process
def test_a_limited_number_of_processes_reads_at_a_time(tmp_path: Path) -> None:
    """Each truth that replaced another before its file was read could have started one more."""
    path = meta_kernel_of_a_pipe(tmp_path)

    async def scenario() -> None:
        reading = [asyncio.create_task(in_thread(read_truth, path)) for _ in range(MAX_PROCESSES + 3)]
        await until(lambda: len(readers_of(os.getpid())) == MAX_PROCESSES)
        await asyncio.sleep(2 * LOOK_S)
        first = readers_of(os.getpid())
        assert len(first) == MAX_PROCESSES
        for task in reading[:MAX_PROCESSES]:
            task.cancel()
        await until(lambda: {*readers_of(os.getpid())} - {*first})
        for task in reading:
            task.cancel()
        await until(lambda: not readers_of(os.getpid()))

    asyncio.run(scenario())


@pytest.mark.process
def test_what_reads_a_file_ends_with_the_run(tmp_path: Path) -> None:
    path = meta_kernel_of_a_pipe(tmp_path)
    program = f"from starhil.emulator.truth.reading_process import *; read_truth(Path({str(path)!r}))"
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        wait_until(lambda: readers_of(process.pid))
        found = readers_of(process.pid)
        process.kill()
    wait_until(lambda: not any(map(is_alive, found)))
