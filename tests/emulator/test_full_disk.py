"""On a full disk, each file that a run writes fails alone: one warning, and the device goes on."""

import contextlib
import resource

import pytest

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.launch import ConsoleOptions, RunOptions
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.runs import command, every_row_read

FULL = 600
"""Largest size of a file, bytes: less than what each writer has to write."""


@contextlib.contextmanager
def full_disk():
    """Let no file grow beyond `FULL`."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def warnings_of(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname in ("WARNING", "ERROR")]


async def track(emulation, seconds=6.0):
    """Let the device take images; return the number of frames."""
    command(emulation, "set_mode", mode="lost_in_space")
    await emulation.stepper.step(seconds)
    return emulation.device.cycle.published


async def track_with_telemetry(emulation):
    """Let the device take images while an OBC reads its telemetry, of which the recording is then full."""
    frames = await track(emulation)
    await every_row_read(emulation)
    return frames


async def track_and_store(emulation):
    """Let the device take images, and store its parameters three times, which it reports as failed."""
    frames = await track(emulation)
    for _ in range(3):
        assert command(emulation, "save_parameters") not in (None, 0)
    return frames


@pytest.mark.parametrize(
    "command_line",
    [
        "fmu export -o made/unit.fmu",
        "icd export c -o made",
        "icd export html -o made/icd.html",
        "unit new made/unit",
    ],
)
def test_a_command_leaves_no_output_that_is_empty(command_line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with full_disk():
        status, _, said = run_command_line(*command_line.split())
    assert status == 2
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


WRITERS = {
    "recording": (track, lambda tmp: {"options": RunOptions(record=tmp / "recorded")}, "recorded"),
    "truth log": (track, lambda tmp: {"options": RunOptions(truth_log=tmp / "truth.csv")}, "truth.csv"),
    "mcap": (
        track_with_telemetry,
        lambda tmp: {"options": RunOptions(console=ConsoleOptions(ConsoleClient, files=(tmp / "run.mcap",)))},
        "run.mcap",
    ),
    "state": (
        track_and_store,
        lambda tmp: {"run": {"clock": "stepped", "state_dir": str(tmp / "state")}},
        "device.json",
    ),
}


@pytest.mark.parametrize(("work", "keys", "name"), WRITERS.values(), ids=WRITERS)
def test_a_writer_on_a_full_disk_fails_alone(run, tmp_path, caplog, work, keys, name):
    frames = []

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        with full_disk():
            frames.append(await work(emulation))
            assert emulation.device.modes.mode.value == "tracking"
            frames.append(await track(emulation))
            await run.launched.close()

    run(scenario, **keys(tmp_path))
    assert 0 < frames[0] < frames[1]
    (said,) = warnings_of(caplog)
    assert name in said
    assert "File too large" in said
    assert run.launched.failed


def test_what_cannot_be_written_at_all_does_not_stop_frames(run, tmp_path, caplog):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        emulation.wiring.write("input", data=object())  # not JSON
        return await track(emulation)

    assert run(scenario, options=RunOptions(record=tmp_path / "recorded")) > 0
    assert len(warnings_of(caplog)) == 1
    assert run.launched.failed


def test_a_run_that_wrote_everything_has_not_failed(run, tmp_path):
    options = RunOptions(record=tmp_path / "recorded", truth_log=tmp_path / "truth.csv")
    run(lambda emulation, _line: track(emulation), options=options)
    assert not run.launched.failed


def test_outputs_fail_one_by_one_with_a_warning_each(run, tmp_path, caplog):
    options = RunOptions(record=tmp_path / "recorded", truth_log=tmp_path / "truth.csv")

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        with full_disk():
            await track(emulation)

    run(scenario, options=options)
    assert len(warnings_of(caplog)) == 2
