"""The first frame after a start is solved like those after it: with the star index for the device's parameters."""

import asyncio

import pytest

from starhil.emulator.profile import load_profile
from starhil.emulator.run import Run
from tests.emulator.runs import FirstHead, command, read
from tests.waiting import PATIENCE_S, until

FRAMES = 3
FEWER_STARS = {"limiting_magnitude": 3.0}
LOST_IN_SPACE = "parameters.start_mode=lost_in_space"


def run(scenario, state_dir, clock="scaled:2", worker="thread"):
    """Run a scenario with a miscalibrated device that keeps its state in a folder."""
    links = ("links.serial.port=off", "links.can.channel=off")
    state = (f"run.clock={clock}", f"run.state_dir={state_dir}", f"run.worker={worker}")
    profile = load_profile("cubestar", [*links, *state, LOST_IN_SPACE])

    async def whole():
        run = Run([profile])
        try:
            await run.open()
            run.begin()
            await asyncio.wait_for(run.ready(), PATIENCE_S)
            emulation = FirstHead(run)
            emulation.shots = []
            emulation.device.signals.frame_published.connect(emulation.shots.append)
            return await asyncio.wait_for(scenario(emulation), PATIENCE_S)
        finally:
            await run.close()

    return asyncio.run(whole())


async def first_frames(emulation):
    """Wait for frames from now on; return the results of the first ones."""
    emulation.shots.clear()
    if emulation.stepper is not None:
        await emulation.stepper.step(FRAMES + 1.0)
    await until(lambda: len(emulation.shots) >= FRAMES)
    return [snapshot.result for snapshot in emulation.shots[:FRAMES]]


def rows(results):
    """Return what the index decides of each frame."""
    return [(result.index, result.index_pending, result.valid, result.matched) for result in results]


@pytest.mark.long
def test_it_is_the_same_on_the_real_and_on_the_stepped_clock(tmp_path):
    stepped = run(first_frames, tmp_path, clock="stepped")
    real = run(first_frames, tmp_path, clock="real")
    assert rows(real) == rows(stepped)
    assert [result.index_pending for result in real] == [False] * FRAMES


@pytest.mark.long
def test_it_is_solved_with_the_stored_parameters(tmp_path):
    async def save(emulation):
        emulation.device.parameters.set(FEWER_STARS)
        emulation.device.save_parameters()

    run(save, tmp_path, worker="error_model")
    results = run(first_frames, tmp_path)
    assert not any(result.index_pending for result in results)
    assert len({result.matched for result in results}) == 1


@pytest.mark.long
def test_after_a_reset_it_is_solved_with_the_restored_parameters(tmp_path):
    async def reset(emulation):
        emulation.device.parameters.set(FEWER_STARS)
        pending = [result.index_pending for result in await first_frames(emulation)]
        assert not pending[-1]  # the index of the changed parameter is in force
        emulation.device.reset("command")
        return await first_frames(emulation)

    assert not any(result.index_pending for result in run(reset, tmp_path))


@pytest.mark.process
def test_after_the_end_of_the_pipeline_which_is_reported_it_is_solved_with_the_current_parameters(tmp_path):
    async def kill(emulation):
        assert all(result.valid for result in await first_frames(emulation))
        emulation.imager.worker.process.kill()
        await until(lambda: emulation.device.modes.mode.value == "error")
        assert emulation.device.modes.error == "processing"
        assert read(emulation, "precise_attitude")["reason"] == "processing_error"
        await until(lambda: emulation.device.warm)  # another one comes up by itself
        command(emulation, "set_mode", mode="standby")
        command(emulation, "set_mode", mode="lost_in_space")
        return await first_frames(emulation)

    results = run(kill, tmp_path, worker="process")
    assert not any(result.index_pending for result in results)
    assert all(result.valid for result in results)
