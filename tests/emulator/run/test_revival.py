"""A pipeline that has ended by itself is started again: with bounded attempts, and an end that is reported."""

import asyncio

import pytest

from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from tests.emulator.runs import CAMERA, FirstHead, command, read
from tests.emulator.workers import ANSWERING, WORKER
from tests.waiting import PATIENCE_S, turns, until

pytestmark = pytest.mark.long

ENDS_AT_ONCE = ""
ENDS_WHEN_READY = WORKER + f"send(PipelineReady({CAMERA}, 5, 0.0))\n"
REJECTS = WORKER + "send(Failure('no catalogue'))\n"
FAILING = (ENDS_AT_ONCE, REJECTS, ENDS_WHEN_READY)


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    """Start a pipeline again at once."""
    monkeypatch.setattr("starhil.emulator.run.revival.PAUSES_S", (0.0,) * len(FAILING))


@pytest.fixture
def run(worker):
    """Run a scenario with an emulation whose workers run the given programs."""

    def run(scenario, *programs):
        profile = Profile.model_validate(
            {
                "run": {"clock": "scaled:20"},
                "device": {"boot_s": 0.1},
                "links": {"serial": {"port": "off"}, "can": {"channel": "off"}},
            }
        )

        async def whole():
            process = worker(*programs)
            run = Run([profile], worker=process)
            try:
                await run.open()
                run.begin()
                await asyncio.wait_for(run.ready(), PATIENCE_S)
                await asyncio.wait_for(scenario(FirstHead(run), process.started), PATIENCE_S)
            finally:
                await run.close()

        asyncio.run(whole())

    return run


def set_mode(emulation, mode):
    return command(emulation, "set_mode", mode=mode).name


async def lose_the_pipeline(emulation, started):
    started[-1].kill()
    await until(lambda: emulation.device.modes.mode == "error")


@pytest.mark.parametrize("others", [(), (REJECTS,)])
def test_modes_can_be_commanded_again_when_the_pipeline_is_back(run, others):
    async def scenario(emulation, started):
        await lose_the_pipeline(emulation, started)
        assert set_mode(emulation, "standby") == "SEQUENCE"
        await until(lambda: emulation.device.warm and len(started) == 2 + len(others))
        assert set_mode(emulation, "standby") == "OK"
        assert set_mode(emulation, "lost_in_space") == "OK"
        await until(lambda: emulation.device.cycle.published > 2)

    run(scenario, ANSWERING, *others, ANSWERING)


def test_a_pipeline_that_does_not_restart_is_abandoned_until_a_reset(run, caplog):
    programs = [ANSWERING, *FAILING, ANSWERING]

    async def scenario(emulation, started):
        device = emulation.device
        await lose_the_pipeline(emulation, started)
        await until(lambda: device.modes.error == "pipeline_ended")
        assert read(emulation, "device_status")["error"] == "pipeline_ended"
        assert "reset the device to try again" in caplog.text
        await turns()
        assert len(started) == 1 + len(FAILING)
        assert set_mode(emulation, "standby") == "SEQUENCE"
        command(emulation, "reset")
        await until(lambda: device.modes.mode == "standby")
        assert set_mode(emulation, "lost_in_space") == "OK"
        await until(lambda: device.cycle.published > 2)

    run(scenario, *programs)
    said = [record.getMessage() for record in caplog.records]
    assert not [line for line in said if "\n" in line]


def test_a_restart_that_the_system_refuses_is_tried_again(run, monkeypatch):
    async def scenario(emulation, started):
        tries = iter([OSError(12, "Cannot allocate memory"), RuntimeError("odd")])
        restart = emulation.imager.restart

        async def refuse_first():
            for error in tries:
                raise error
            return await restart()

        monkeypatch.setattr(emulation.imager, "restart", refuse_first)
        await lose_the_pipeline(emulation, started)
        await until(lambda: emulation.device.warm)
        assert set_mode(emulation, "standby") == "OK"

    run(scenario, ANSWERING)


def test_a_reset_while_the_pipeline_is_started_again_ends_in_standby(run):
    async def scenario(emulation, started):
        await lose_the_pipeline(emulation, started)
        emulation.device.reset("command")
        assert emulation.device.modes.mode == "boot"
        await until(lambda: emulation.device.modes.mode == "standby")

    run(scenario, ANSWERING)
