"""Restarts of the image pipeline after it has ended unexpectedly.

The number of attempts is limited, and the pauses before them increase. After `STEADY_S` without a failure, counting
starts again. When no attempts are left, the device stays in the error mode with the error `pipeline_ended` until it
is reset, which starts the attempts again.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from starhil.emulator.device.device import PIPELINE_ENDED, Device
from starhil.emulator.errors import EmulatorError, one_line
from starhil.emulator.profile.pipeline_setup import SensorPipeline
from starhil.emulator.sensor.pipeline.messages import PipelineReady

log = logging.getLogger("starhil.run")

PAUSES_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Pauses before the attempts to restart the pipeline, seconds."""

STEADY_S: Final = 60.0


class PipelineRevival:
    """Restarts the pipeline of a device; `record` writes an entry on the tape, if there is one."""

    def __init__(
        self,
        imager: SensorPipeline,
        device: Device,
        ready: Callable[[PipelineReady], None],
        record: Callable[[str], None],
    ) -> None:
        self._imager = imager
        self._device = device
        self._ready = ready
        self._record = record
        self._attempts = 0
        self._ready_at_s = 0.0
        self._lost = False
        self._task: asyncio.Task[None] | None = None
        imager.ended.connect(self._pipeline_lost)
        device.signals.restarted.connect(self._device_reset)

    def _pipeline_lost(self, _text: str) -> None:
        if asyncio.get_running_loop().time() - self._ready_at_s > STEADY_S:
            self._attempts = 0
        self._lost = True
        self._record("pipeline_lost")
        self._device.pipeline_lost()
        self._start_attempts()

    def _device_reset(self, _cause: str) -> None:
        if self._lost and self._attempts == len(PAUSES_S):
            self._attempts = 0
            self._start_attempts()

    def _start_attempts(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._revive())

    async def _revive(self) -> None:
        while self._lost and self._attempts < len(PAUSES_S):
            pause_s = PAUSES_S[self._attempts]
            self._attempts += 1
            progress = f"attempt {self._attempts} of {len(PAUSES_S)}"
            log.warning("image pipeline: restarting in %g s (%s)", pause_s, progress)
            await asyncio.sleep(pause_s)
            await self._restart()
        if self._lost:
            log.error(
                "image pipeline: ended %d times, not restarted; error %s: "
                "reset the device to try again, or restart the emulator",
                len(PAUSES_S) + 1,
                PIPELINE_ENDED,
            )
            self._record("pipeline_given_up")
            self._device.pipeline_given_up()

    async def _restart(self) -> None:
        self._lost = False
        try:
            warm = await self._imager.restart()
        except Exception as error:  # noqa: BLE001 (whatever it is, the next attempt may succeed)
            self._lost = True
            what = str(error) if isinstance(error, EmulatorError) else one_line(error)
            log.warning("image pipeline: not started: %s", what)
            return
        if self._lost:  # it has already ended again
            return
        self._ready_at_s = asyncio.get_running_loop().time()
        log.info("pipeline ready again: %.2f s", warm.seconds)
        self._record("ready")
        self._ready(warm)

    async def close(self) -> None:
        """Cancel an attempt in progress."""
        self._imager.ended.disconnect(self._pipeline_lost)
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})
