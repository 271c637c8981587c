"""The tester's side of a unit on CAN with the CubeSpace layout of CAN IDs; checks every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from starhil.hil_tests.client.raw_traffic import matches, parse_frame, pattern
from starhil.hil_tests.conformance.case import check
from starhil.hil_tests.conformance.link_probe import LinkProbe, ProbeTimes, Settings
from starhil.hil_tests.conformance.ports import CanFrame, Port
from starhil.hil_tests.judge import can
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Answer, Request


class CanProbe(LinkProbe):
    """Talks to a unit over a CAN bus.

    `host` and `device` are the CAN addresses of the tester and of the device.
    """

    link = "can"

    def __init__(
        self,
        bus: Port[CanFrame],
        unit: Unit,
        *,
        host: int = 1,
        device: int = 4,
        times: ProbeTimes | None = None,
        settings: Settings | None = None,
    ) -> None:
        super().__init__(bus, unit, times, settings)
        self.host = host
        self.device = device
        self._frames: list[CanFrame] = []

    def post_request(self, request: Request, *, answered: bool = True) -> None:  # noqa: ARG002 -- answers name their row
        """Send a request without waiting."""
        for can_id, data in can.frames_of(request, self.host, self.device):
            self.send(CanFrame(can_id, data))

    def send(self, frame: CanFrame) -> None:
        self.log.append(f"{self.now():.4f} -> {frame!s}")
        self.port.send(frame)

    @property
    def addresses(self) -> Mapping[str, str]:
        """The addresses of tester and device, as in CAN IDs."""
        return {"host": f"{self.host:02X}", "device": f"{self.device:02X}"}

    def exchange(self, sent: Sequence[str], answers: Sequence[str]) -> None:
        """Send frames, and take frames that match the patterns."""
        for text in sent:
            self.send(parse_frame(text))
        for answer in answers:
            expected = pattern(answer)
            frame = self.next_frame()
            seen = "nothing" if frame is None else str(frame)
            check(matches(expected, seen), expected, seen)

    def _receive(self, timeout_s: float) -> bool:
        frame = self.port.receive(timeout_s)
        if frame is None:
            return False
        if not frame.extended or frame.remote or frame.id >> 8 & 0xFF != self.device:
            return True
        self.log.append(f"{self.now():.4f} <- {frame!s}")
        (self.unsolicited if frame.id >> 24 in can.UNSOLICITED else self._frames).append(frame)
        return True

    def drain(self) -> None:
        """Discard everything received."""
        super().drain()
        self._frames.clear()
        self.unsolicited.clear()

    def _unsolicited_answers(self) -> list[Answer]:
        return can.unsolicited(self.unsolicited)

    def next_frame(self, timeout_s: float | None = None) -> CanFrame | None:
        """Return the next frame of the device that is not unsolicited, or None."""
        end = self.now() + (self.times.answer_s if timeout_s is None else timeout_s)
        while not self._frames:
            left = end - self.now()
            if left <= 0 or not self._receive(left):
                break
        return self._frames.pop(0) if self._frames else None

    def _answer_within(self, seconds: float) -> Answer | None:
        frame = self.next_frame(seconds)
        return None if frame is None else can.read_answer(frame, self.next_frame)
