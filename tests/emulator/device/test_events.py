"""Telemetry that reports events is sent once for each of them."""

import shutil

import pytest

from starhil.protocol.files.bundled import UNITS_FOLDER

EVENTS = ("start", "frame", "mode", "error", "validity")


@pytest.fixture
def events(make_bench, tmp_path):
    """A device in standby, and the names of the events that it has reported since; reading empties the list."""
    folder = tmp_path / "unit"
    shutil.copytree(UNITS_FOLDER / "cubestar", folder)
    rows = (
        f"[[telemetry]]\nid = {145 + number}\nname = 'on_{event}'\ndoc = 'd'\nprovenance = 'ours'\n"
        f"unsolicited = ['{event}']\nfields = [{{ type = 'u8' }}]\n"
        for number, event in enumerate(EVENTS)
    )
    (folder / "90-events.toml").write_text("".join(rows))
    bench = make_bench(unit=str(folder))
    names = []
    ids = {row.id: row.name.removeprefix("on_") for row in bench.icd.telemetry.values()}
    bench.device.signals.unsolicited.connect(lambda reply: names.append(ids[reply.id]))
    bench.start()

    def reported():
        found = list(names)
        names.clear()
        return found

    return bench, reported


def test_events_are_reported_once_each(events):
    bench, reported = events
    assert reported() == ["start", "mode"]
    bench.command("set_mode", mode="lost_in_space")
    assert reported() == ["mode"]
    bench.step(1.0)
    seen = reported()
    assert seen.count("validity") == 1
    assert seen.count("frame") == bench.device.cycle.published
    bench.command("set_mode", mode="standby")
    assert sorted(reported()) == ["mode", "validity"]
    bench.device.modes.fail("sensor")
    assert sorted(reported()) == ["error", "mode"]
