"""Raw bytes and CAN frames as text, for sessions and conformance cases: parsing, sending, and comparing answers with patterns."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Sequence
from typing import Any, Final

from starhil.hil_tests.client.async_client import AsyncObcClient
from starhil.hil_tests.client.links import HostLink
from starhil.hil_tests.errors import BenchError
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError

_FRAME: Final = re.compile(r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(R|(?:[0-9A-Fa-f]{2}|\.\.){0,8}\*?)")
_POLL_S: Final = 0.02
_BYTES: Final = re.compile(r"(?:[0-9A-F]{2}|\.\.)*\*?")


def parse_frame(text: str) -> CanFrame:
    """Parse a frame in the format of `cansend`: `07360104#0001020304050601`, `123#R`.

    Raises BenchError: the text is not in this format.
    """
    compact = text.replace(" ", "")
    match = _FRAME.fullmatch(compact)
    if match is None or ".." in compact or "*" in compact:
        raise BenchError(f"not a CAN frame in the format of cansend: {text!r}")
    can_id, data = match.groups()
    try:
        if data == "R":
            return CanFrame(int(can_id, 16), b"", len(can_id) == 8, remote=True)
        return CanFrame(int(can_id, 16), bytes.fromhex(data), len(can_id) == 8)
    except ProtocolError as error:
        raise BenchError(f"{text!r}: {error}") from None


def pattern(text: str) -> str:
    """Normalise the pattern of an answer: capitals without blanks; `..` matches any byte, a final `*` any others.

    Raises BenchError: the text is neither hexadecimal bytes nor a frame.
    """
    compact = text.replace(" ", "").upper()
    if _BYTES.fullmatch(compact) is None and _FRAME.fullmatch(compact) is None:
        raise BenchError(f"not bytes in hexadecimal or a CAN frame: {text!r}")
    return compact


def matches(expected: str, seen: str) -> bool:
    """Return whether hexadecimal bytes or a frame, in capitals, match a pattern."""
    digits = "[0-9A-F]"
    return re.fullmatch(expected.replace("..", f"{digits}{{2}}").replace("*", f"{digits}*"), seen) is not None


async def send_and_listen(
    client: AsyncObcClient,
    items: Sequence[bytes | CanFrame],
    listen_s: float,
    patterns: Sequence[str] = (),
    timeout_s: float | None = None,
) -> tuple[str, ...]:
    """Send bytes (serial) or frames (CAN), and return the answer as one text of bytes, or as frames.

    Listens for `listen_s`, and for up to `timeout_s` (default: that of the client) until as much has arrived as the
    patterns in `patterns` have.
    """
    link = client.link
    size = len("".join(patterns).replace("*", ""))
    end = time.monotonic() + (client.timeout_s if timeout_s is None else timeout_s)
    received: list[Any] = []
    before, link.on_raw = link.on_raw, received.append
    try:
        for item in items:
            link.send(item)
        await asyncio.sleep(listen_s)
        while len("".join(_format_received(link, received))) < size and time.monotonic() < end:
            await asyncio.sleep(_POLL_S)
    finally:
        link.on_raw = before
    return _format_received(link, received)


def _format_received(link: HostLink[Any], received: list[Any]) -> tuple[str, ...]:
    """Return one text of all bytes, or one per frame of the device."""
    if link.name == "serial":
        return (b"".join(received).hex().upper(),)
    return tuple(str(frame) for frame in received if link.is_from_device(frame))
