import pytest

from starhil.emulator.device.modes import Cause, Mode, Modes
from starhil.protocol.messages import ErrorCode


def modes_in(mode: Mode) -> Modes:
    modes = Modes()
    modes.mode = mode
    return modes


ALLOWED = {
    (Mode.STANDBY, Mode.STANDBY),
    (Mode.STANDBY, Mode.LOST_IN_SPACE),
    (Mode.STANDBY, Mode.TRACKING),
    (Mode.LOST_IN_SPACE, Mode.STANDBY),
    (Mode.LOST_IN_SPACE, Mode.LOST_IN_SPACE),
    (Mode.LOST_IN_SPACE, Mode.TRACKING),
    (Mode.TRACKING, Mode.STANDBY),
    (Mode.TRACKING, Mode.LOST_IN_SPACE),
    (Mode.TRACKING, Mode.TRACKING),
    (Mode.ERROR, Mode.STANDBY),
}


@pytest.mark.parametrize("wanted", Mode)
@pytest.mark.parametrize("here", Mode)
def test_commands_lead_only_where_the_machine_allows(here, wanted):
    modes = modes_in(here)
    assert modes.command(wanted, has_attitude=True) == ((here, wanted) in ALLOWED)
    assert modes.mode is (wanted if (here, wanted) in ALLOWED else here)


def test_tracking_needs_an_attitude():
    modes = modes_in(Mode.STANDBY)
    assert not modes.command(Mode.TRACKING, has_attitude=False)
    assert modes.mode is Mode.STANDBY


@pytest.mark.parametrize(
    ("here", "valid", "tracked", "enabled", "there"),
    [
        (Mode.LOST_IN_SPACE, True, False, True, Mode.TRACKING),
        (Mode.LOST_IN_SPACE, True, False, False, Mode.LOST_IN_SPACE),
        (Mode.LOST_IN_SPACE, False, False, True, Mode.LOST_IN_SPACE),
        (Mode.TRACKING, True, True, True, Mode.TRACKING),
        (Mode.TRACKING, False, True, True, Mode.LOST_IN_SPACE),
        (Mode.TRACKING, True, True, False, Mode.LOST_IN_SPACE),
        (Mode.STANDBY, True, False, True, Mode.STANDBY),
        (Mode.ERROR, True, True, True, Mode.ERROR),
    ],
)
def test_results_change_the_mode(here, valid, tracked, enabled, there):
    modes = modes_in(here)
    modes.solved(valid=valid, tracked=tracked, tracking_enabled=enabled)
    assert modes.mode is there


def test_mode_changes_are_reported_with_their_cause():
    transitions = []
    modes = Modes(transitions.append)
    modes.booted()
    modes.fail("sensor")
    assert modes.error == "sensor"
    modes.command(Mode.STANDBY, has_attitude=False)
    modes.command(Mode.STANDBY, has_attitude=False)
    assert modes.error == ""
    assert [(t.after, t.cause) for t in transitions] == [
        (Mode.STANDBY, Cause.BOOTED),
        (Mode.ERROR, Cause.FAULT),
        (Mode.STANDBY, Cause.COMMAND),
    ]


def test_a_listener_sees_the_reason_of_an_error():
    seen = []
    modes = Modes(lambda _transition: seen.append(modes.error))
    modes.fail("sensor")
    assert seen == ["sensor"]


def test_boot_ends_only_from_boot():
    modes = modes_in(Mode.ERROR)
    modes.booted()
    assert modes.mode is Mode.ERROR


def test_the_device_counts_changes_of_mode_and_not_commands_of_the_present_one(bench):
    before = bench.read("device_status")["mode_changes"]
    for mode in ("lost_in_space", "lost_in_space", "standby"):
        assert bench.command("set_mode", mode=mode) is ErrorCode.OK
    assert bench.read("device_status")["mode_changes"] == before + 2


def test_only_a_reset_leaves_the_error_of_a_pipeline_that_was_given_up(bench):
    bench.device.pipeline_lost()
    assert bench.mode == "error"
    bench.device.pipeline_given_up()
    assert (bench.mode, bench.device.modes.error) == ("error", "pipeline_ended")
    bench.command("set_mode", mode="standby")
    assert bench.mode == "error"


def test_a_device_boots_whose_clock_was_set_in_its_last_life(bench):
    bench.command("set_unix_time", seconds=1, milliseconds=0)
    assert bench.device.time.was_set
    bench.device.power_on()
    assert not bench.device.time.was_set
