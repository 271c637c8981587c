import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.clock import DeviceTime, RealClock, ScaledClock, SteppedClock, make_clock
from starhil.emulator.simulation.scheduler import Scheduler


def test_the_stepped_clock_stands_still_until_stepped():
    clock = SteppedClock()
    assert clock.now_ns() == clock.now_ns() == 0
    clock.set_ns(1_500)
    assert clock.now_ns() == 1_500


def test_stepped_clock_never_goes_back():
    clock = SteppedClock()
    clock.set_ns(10)
    with pytest.raises(EmulatorError, match="back"):
        clock.set_ns(9)


def test_scaled_clock_follows_its_factor(monkeypatch):
    wall = [1_000]
    monkeypatch.setattr("time.monotonic_ns", lambda: wall[0])
    clock = ScaledClock(10.0)
    clock.switch_on(wall[0], 50_000_000)
    clock.start()
    wall[0] += 7_000_000
    assert clock.now_ns() == 70_000_000


@pytest.mark.parametrize(
    ("start_ns", "stands_at_ns"),
    [(3_000_000, 30_000_000), (5_000_000, 50_000_000), (900_000_000, 50_000_000)],
)
def test_time_stands_still_at_the_end_of_the_boot_until_it_is_started(monkeypatch, start_ns, stands_at_ns):
    wall = [1_000]
    monkeypatch.setattr("time.monotonic_ns", lambda: wall[0])
    clock = ScaledClock(10.0)
    assert clock.now_ns() == 0
    clock.switch_on(0, 50_000_000)
    wall[0] = start_ns
    assert clock.now_ns() == stands_at_ns
    clock.start()
    assert clock.now_ns() == stands_at_ns
    wall[0] += 700_000_000
    assert clock.now_ns() == stands_at_ns + 7_000_000_000


@pytest.mark.parametrize(
    ("text", "name", "speed"),
    [("real", "real", 1.0), ("scaled:10", "scaled:10", 10.0), ("stepped", "stepped", 0.0)],
)
def test_clocks_are_made_by_name(text, name, speed):
    clock = make_clock(text)
    assert (clock.name, clock.speed) == (name, speed)


@pytest.mark.parametrize(
    "text", ["", "fast", "scaled:", "scaled:x", "scaled:0", "scaled:-1", "scaled:1e9", "scaled:nan"]
)
def test_unknown_clocks_are_rejected_in_one_line(text):
    with pytest.raises(EmulatorError) as refusal:
        make_clock(text)
    assert "\n" not in str(refusal.value)


def test_device_time_runs_on_from_the_set_time():
    clock = SteppedClock()
    time = DeviceTime(clock)
    clock.set_ns(5_000_000_000)
    time.set_unix_ns(1_800_000_000_123_456_789)
    clock.set_ns(5_000_000_250)
    assert time.unix_ns() == 1_800_000_000_123_457_039
    assert time.unix_ns(5_000_000_000) == 1_800_000_000_123_456_789


def test_real_clock_passes_with_the_wall_clock(monkeypatch):
    wall = [5]
    monkeypatch.setattr("time.monotonic_ns", lambda: wall[0])
    clock = RealClock()
    clock.switch_on(wall[0], 0)
    clock.start()
    wall[0] += 42
    assert clock.now_ns() == 42


def run_due(scheduler, now_ns):
    while (event := scheduler.pop_due(now_ns)) is not None:
        event.action(event.due_ns)


def test_events_come_in_order_of_time_then_of_entry():
    scheduler, calls = Scheduler(), []
    for name, due in (("late", 30), ("first", 10), ("second", 10), ("between", 20)):
        scheduler.at(due, lambda _due, name=name: calls.append(name))
    run_due(scheduler, 20)
    assert calls == ["first", "second", "between"]
    assert scheduler.next_due_ns() == 30


def test_an_event_may_enter_another_that_is_due_at_once():
    scheduler, seen = Scheduler(), []
    scheduler.at(5, lambda due: scheduler.at(due, lambda _due: seen.append("child")))
    run_due(scheduler, 5)
    assert seen == ["child"]


def test_a_cancelled_event_does_nothing():
    scheduler, calls = Scheduler(), []
    event = scheduler.at(5, lambda _due: calls.append(1))
    event.cancel()
    assert scheduler.next_due_ns() is None
    run_due(scheduler, 10)
    assert calls == []
