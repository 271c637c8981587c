"""Answers that take time: a parameter is being saved, an image is being captured or opened.

The code that does the work returns a `PendingAnswer` immediately, and completes it once with the result. The code that
owes the answer registers what is to be done with the result. Either may happen first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

Result = TypeVar("Result")
Other = TypeVar("Other")


class PendingAnswer(Generic[Result]):
    """The result of some work, once it is done.

    If it is `accepted`, the telecommand is answered at once; only telemetry then reports the result.
    """

    def __init__(self, *, accepted: bool = False) -> None:
        self.accepted = accepted
        self._results: list[Result] = []
        self._observers: list[Callable[[Result], object]] = []

    @property
    def done(self) -> bool:
        return bool(self._results)

    def end(self, result: Result) -> None:
        """Report that the work is done."""
        self._results.append(result)
        for act in self._observers:
            act(result)

    def when_done(self, act: Callable[[Result], object]) -> None:
        """Call a function with the result: now, if the work is done."""
        if self._results:
            act(self._results[0])
        else:
            self._observers.append(act)

    def then(self, convert: Callable[[Result], Other], *, accepted: bool = False) -> PendingAnswer[Other]:
        answer = PendingAnswer[Other](accepted=accepted)
        self.when_done(lambda result: answer.end(convert(result)))
        return answer
