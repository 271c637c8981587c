"""Messages that are texts: requests without a header, and the answers that acknowledge or refuse them."""

from __future__ import annotations

import re
from typing import Final

from starhil.protocol.link_schema import SerialLinkModel
from starhil.protocol.messages import Reply, ReplyKind

CODE: Final = "{code}"
"""Stands for the error's number in the text of a refusal."""


def words(text: str) -> str:
    """Return a text with single spaces between its words, by which requests are compared."""
    return " ".join(text.split())


class TextReplies:
    """The texts by which a link acknowledges a telecommand, and refuses a request."""

    def __init__(self, link: SerialLinkModel) -> None:
        self.acknowledge: Final = link.acknowledge
        self.refusal: Final = link.refusal
        before, code, after = (link.refusal or "").partition(CODE)
        self._refused = re.compile(re.escape(before) + (r"(\d{1,5})" if code else "()") + re.escape(after))

    def encode(self, reply: Reply) -> bytes | None:
        """Return the text of a reply; None if the reply has header and data."""
        if reply.kind is ReplyKind.ACK and self.acknowledge is not None and not reply.data:
            return self.acknowledge.encode("ascii")
        if reply.kind is ReplyKind.NACK and self.refusal is not None:
            return self.refusal.replace(CODE, str(int(reply.code))).encode("ascii")
        return None

    def decode(self, body: bytes) -> tuple[ReplyKind, int] | None:
        """Return kind and error number of a text; None if it is neither an acknowledge nor a refusal."""
        text = body.decode("latin-1")
        if text == self.acknowledge:
            return ReplyKind.ACK, 0
        found = self._refused.fullmatch(text) if self.refusal is not None else None
        return None if found is None else (ReplyKind.NACK, int(found[1] or 0))
