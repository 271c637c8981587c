"""An event loop whose time advances only while all tasks wait, so that a run takes no longer than its computation."""

from __future__ import annotations

import asyncio
import selectors
from typing import Any, Final

WORKER_WAIT_S: Final = 0.001
"""Wall time between two checks of a pipeline in a thread, seconds."""


class _SimulatedSelector(selectors.SelectSelector):
    """Never waits for a timer: the time that would be waited is added to `time`. Files are looked at once nothing else is due."""

    def __init__(self) -> None:
        super().__init__()
        self.time = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout == 0:
            return []
        events = super().select(0 if timeout is not None else WORKER_WAIT_S)
        if not events and timeout is not None:
            self.time += timeout
        return events


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop in simulated time, which begins at zero."""

    def __init__(self) -> None:
        self._simulated = _SimulatedSelector()
        super().__init__(self._simulated)

    def run_in_executor(  # type: ignore[override]  # the types of the arguments belong to the base class
        self, _executor: Any, func: Any, *args: Any
    ) -> asyncio.Future[Any]:
        """Call a function now: a thread would take an unknown share of the simulated time."""
        future = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 (it belongs to whoever waits)
            future.set_exception(error)
        return future

    def time(self) -> float:
        """Return the simulated time, seconds."""
        return self._simulated.time
