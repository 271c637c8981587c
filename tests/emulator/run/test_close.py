"""The end of a run, whatever it is doing then: nothing happens after it, and no failure is lost."""

import asyncio
import threading

import pytest

from starhil.emulator.control.channel import ControlServer
from starhil.emulator.device.state_store import FileStore
from starhil.emulator.errors import EmulatorError
from tests.emulator.runs import command
from tests.waiting import PATIENCE_S, turns, until

LONG_STEP_S = 86_400.0
REQUEST = bytes.fromhex("1F7FE61FFF")


def test_a_step_ends_with_the_run(run):
    async def scenario(emulation, _line):
        stepping = asyncio.create_task(emulation.stepper.step(LONG_STEP_S))
        await until(lambda: emulation.device.cycle.published > 0)
        await run.launched.close()
        await asyncio.wait({stepping}, timeout=PATIENCE_S)
        assert stepping.cancelled()
        return emulation.device.cycle.published, emulation.clock.now_ns()

    frames, ended_ns = run(scenario, parameters={"start_mode": "lost_in_space"})
    assert frames > 0
    assert ended_ns < LONG_STEP_S * 1e9


def test_nothing_is_received_while_the_run_ends(run, monkeypatch):
    """Closing takes many turns of the loop, which a storm of requests makes long."""
    closed = ControlServer.close

    async def scenario(emulation, _line):
        received = []
        (link,) = emulation.links.values()
        with open(emulation.ready_fields["serial"], "r+b", buffering=0) as peer:  # noqa: PTH123

            async def send_and_close(server):
                monkeypatch.undo()
                peer.write(REQUEST)
                for _ in range(10):
                    await asyncio.sleep(0)
                received.append(link.transport.statistics.received)
                received.append(emulation.device.counters.telemetry)
                closed(server)

            monkeypatch.setattr(ControlServer, "close", send_and_close)
            await run.launched.close()
        return received

    assert run(scenario) == [len(REQUEST), 0]


def test_no_events_run_while_the_heads_are_closed(run):
    """A simulator in lock-step, or a control request, may have begun a step that takes much longer than closing."""

    async def scenario(emulation, _line):
        stepping = asyncio.create_task(emulation.stepper.step(LONG_STEP_S))
        frames = []
        first, second = emulation.run.heads
        await until(lambda: first.device.cycle.published > 0)
        close = second.imager.close

        async def slow_close():
            await close()
            frames.append(first.device.cycle.published)
            await turns()
            frames.append(first.device.cycle.published)

        second.imager.close = slow_close
        await run.launched.close()
        stepping.cancel()
        return frames[:2]

    tracking = {"parameters": {"start_mode": "lost_in_space"}}
    before, after = run(scenario, others=[{"run": {"clock": "stepped", "seed": 2}, **tracking}], **tracking)
    assert before == after > 0


def test_a_last_write_that_fails_is_reported(run, tmp_path, monkeypatch, caplog):
    """The failure arrives in the event loop after the thread that writes has ended."""

    async def scenario(emulation, _line):
        closing = threading.Event()

        def fail_slowly(_store, _content):
            closing.wait(PATIENCE_S)
            raise EmulatorError("no space left")

        monkeypatch.setattr(FileStore, "save", fail_slowly)
        command(emulation, "save_parameters")
        ending = asyncio.create_task(run.launched.close())
        await turns()
        assert not ending.done()
        closing.set()
        await ending
        return run.launched.failed

    state = {"clock": "real", "state_dir": str(tmp_path)}
    assert run(scenario, run=state, device={"boot_s": 0.1})
    assert "no space left" in caplog.text


def test_a_start_that_one_head_rejects_is_counted_by_no_head(run, tmp_path, monkeypatch):
    async def scenario(emulation, _line):
        return emulation.device.boot_count

    first = {"clock": "stepped", "state_dir": str(tmp_path / "first")}
    second = {"clock": "stepped", "seed": 2, "state_dir": str(tmp_path / "second")}
    assert run(scenario, run=first, others=[{"run": second}]) == 1
    with monkeypatch.context() as patch:
        patch.setattr("tests.emulator.runs.FakeImager.start", _fails_for_the_second())
        with pytest.raises(EmulatorError, match="no catalogue"):
            run(scenario, run=first, others=[{"run": second}])
    assert run(scenario, run=first, others=[{"run": second}]) == 2


def _fails_for_the_second():
    from tests.emulator.runs import FakeImager

    start, started = FakeImager.start, []

    async def fail_second(imager):
        started.append(imager)
        if len(started) == 2:
            raise EmulatorError("no catalogue")
        return await start(imager)

    return fail_second


def test_a_state_that_cannot_be_read_leaves_its_folder_free(run, tmp_path):
    """The store is opened before the state is read."""

    async def scenario(emulation, _line):
        return emulation.device.boot_count

    state = {"clock": "stepped", "state_dir": str(tmp_path)}
    (tmp_path / "device.json").mkdir()
    for _ in range(2):
        with pytest.raises(EmulatorError) as rejected:
            run(scenario, run=state)
        assert "in use" not in str(rejected.value)
