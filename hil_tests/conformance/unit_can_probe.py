"""The tester's side of any unit on CAN with the CubeSpace layout of CAN IDs, based on its definition."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.can_probe import CanWire
from starhil.hil_tests.conformance.case import CaseFailed
from starhil.hil_tests.conformance.link_probe import Answer, AnswerKind
from starhil.hil_tests.conformance.unit_probe import UnitProbe
from starhil.protocol.messages import FaultKind, LinkFault, Reply, ReplyKind, Request

KINDS: Final[dict[AnswerKind, ReplyKind]] = {
    "ack": ReplyKind.ACK,
    "nack": ReplyKind.NACK,
    "telemetry": ReplyKind.TELEMETRY,
    "burst": ReplyKind.BURST,
    "unsolicited": ReplyKind.UNSOLICITED,
}


class CanUnitProbe(CanWire, UnitProbe):
    """Talks to a unit over a CAN bus."""

    def post(self, request: Request, *, answered: bool = True) -> None:  # noqa: ARG002 -- answers name their row
        """Send a request without waiting."""
        self.post_as(self.host, request.id, request.data)

    def next_reply(self) -> Reply | LinkFault | None:
        """Return the next reply, or None if none arrives in time."""
        answer = self.next_answer()
        if answer.kind == "none":
            return None
        if answer.kind == "malformed":
            return LinkFault(FaultKind.CAN_TYPE, answer.data.hex(" "))
        return _reply(answer)

    def unsolicited_replies(self, seconds: float) -> list[Reply]:
        """Return the messages of unsolicited telemetry that arrive within a time."""
        return [_reply(answer) for answer in self.receive_unsolicited(seconds)]

    def expect_silence(self, why: str, seconds: float | None = None) -> None:
        """Fail the case if anything arrives within a time."""
        answer = self.unexpected_answer(self.times.quiet_s if seconds is None else seconds)
        if answer.kind != "none":
            raise CaseFailed(f"nothing ({why})", str(answer))


def _reply(answer: Answer) -> Reply:
    return Reply(KINDS[answer.kind], answer.row_id, answer.data, answer.code)
