"""A start that is rejected leaves nothing behind that would block the next one."""

import pytest

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import ConsoleOptions, RunOptions
from starhil.protocol.errors import ProtocolError
from tests.emulator.runs import FakeImager

pytestmark = pytest.mark.long

NO_PORT = {"serial": {"port": "/dev/no-such-port"}, "can": {"channel": "off"}}


def options(tmp_path, view="off", **more):
    return RunOptions(
        record=tmp_path / "recorded",
        truth_log=tmp_path / "truth.csv",
        console=ConsoleOptions(ConsoleClient, view, files=(tmp_path / "run.mcap",)),
        **more,
    )


async def nothing(_emulation, _line):
    return


@pytest.mark.parametrize(
    ("keys", "more"),
    [
        ({"links": NO_PORT}, {}),
        ({}, {"scenario": "no-such-scenario"}),
        ({}, {"control": "unix:relative"}),
        ({}, {"view": "nowhere"}),
        ({"truth": {"kind": "file", "path": "no-such-file.csv"}}, {}),
    ],
    ids=["port", "scenario", "control", "console", "truth"],
)
def test_no_file_is_left(run, tmp_path, keys, more):
    with pytest.raises((EmulatorError, ProtocolError)):
        run(nothing, options=options(tmp_path, **more), **keys)
    assert list(tmp_path.iterdir()) == []
    run(nothing, options=options(tmp_path))
    assert len(list(tmp_path.iterdir())) == 3


def test_no_file_is_left_if_the_pipeline_does_not_start(run, tmp_path, monkeypatch):
    async def start(_self):
        raise EmulatorError("no catalogue")

    monkeypatch.setattr(FakeImager, "start", start)
    with pytest.raises(EmulatorError, match="no catalogue"):
        run(nothing, options=options(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_files_of_the_user_is_left_alone(run, tmp_path):
    (tmp_path / "recorded").mkdir()
    (tmp_path / "recorded" / "notes.txt").write_text("x")
    with pytest.raises(EmulatorError, match="not empty"):
        run(nothing, options=options(tmp_path))
    assert (tmp_path / "recorded" / "notes.txt").read_text() == "x"
