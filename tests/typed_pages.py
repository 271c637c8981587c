"""What the pages have their reader type, and the frames that they show."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from starhil.hil_tests.client.raw_traffic import parse_frame
from starhil.protocol.can.cubespace import MessageType
from starhil.protocol.can.frame import CanFrame

DOCS = Path(__file__).parents[1] / "docs"
UNASKED = {0x0CE60401, 0x185}
"""Unsolicited telemetry, and the status that a change of mode sends: they may come between any two frames."""
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, the heading that it stands under."""

    language: str
    text: str
    heading: str


def blocks(name: str, language: str = "") -> list[Block]:
    text = (DOCS / name).read_text(encoding="utf-8")
    return [
        Block(match[1], match[2], re.findall(r"^#+ (.*)$", text[: match.start()], re.MULTILINE)[-1])
        for match in _FENCE.finditer(text)
        if language in ("", match[1])
    ]


@dataclass(frozen=True)
class Exchange:
    """A frame that the walk-through sends with cansend, and the frames that it shows as the answer."""

    typed: str
    sent: CanFrame
    answers: list[CanFrame]


def exchanges(headings: set[str]) -> list[Exchange]:
    links = []
    for block in blocks("walkthrough.md"):
        if block.language != "console" or block.heading not in headings:
            continue
        for part in block.text.split("$ cansend vcan0 ")[1:]:
            typed, *dump = part.splitlines()
            seen = [dumped(line) for line in dump]
            assert str(seen[0]) == typed, "candump shows another frame than cansend sent"
            links.append(Exchange(f"cansend vcan0 {typed}", seen[0], seen[1:]))
    return links


def dumped(line: str) -> CanFrame:
    channel, identifier, size, *data = line.split()
    frame = CanFrame(int(identifier, 16), bytes.fromhex("".join(data)), extended=len(identifier) == 8)
    assert (channel, size) == ("vcan0", f"[{len(frame.data)}]")
    return frame


def fixed(frame: CanFrame) -> bytes:
    """Return the part of a frame that does not depend on time and noise."""
    if frame.extended:
        kind = MessageType(frame.id >> 24)
        measured = kind not in (MessageType.TELECOMMAND_NACK, MessageType.TELEMETRY_NACK)
        acknowledge = frame.id >> 16 & 0xFF == 240
        return b"" if measured and not acknowledge else frame.data
    if frame.id == 0x585:
        read = frame.data[0] & 0xE0 == 0x40
        return frame.data[:4] if read else frame.data
    return b""


@dataclass(frozen=True)
class TypedPage:
    """What a page has its reader type: the start of the emulator, candump, and the frames that are exchanged."""

    run: str
    candump: str
    exchanges: list[Exchange]


def typed_page(lines: list[str], found: list[Exchange]) -> TypedPage:
    (run,) = (line for line in lines if line.startswith("starhil run"))
    (candump,) = (line.removesuffix(" &") for line in lines if line.startswith("candump"))
    return TypedPage(run, candump, found)


def readme_page() -> TypedPage:
    text = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    section = text[text.index("**SocketCAN**") : text.index("**Where the kernel has no CAN**")]
    lines = [line.strip() for line in section.splitlines() if line.startswith("    ")]
    typed = [line for line in lines if line.startswith("cansend")]
    # it shows no answers: identification, acknowledge, quaternion
    answers = [CanFrame(0x05800401, bytes(8)), CanFrame(0x02600401), CanFrame(0x05E60401, bytes(6))]
    return typed_page(
        lines,
        [
            Exchange(line, parse_frame(line.split()[2]), [answer])
            for line, answer in zip(typed, answers, strict=True)
        ],
    )


def walkthrough_page(heading: str, parts: set[str], count: int) -> TypedPage:
    (start,) = (b for b in blocks("walkthrough.md", language="sh") if b.heading == heading)
    text = (DOCS / "walkthrough.md").read_text(encoding="utf-8")
    filtered = re.findall(r"`(candump vcan0,\S+)`", text) if "--canopen" in start.text else []
    found = exchanges(parts)
    assert len(found) == count
    return typed_page([*start.text.splitlines(), *filtered], found)


PAGES = {
    "README": readme_page(),
    "CAN": walkthrough_page(
        "1. CAN with can-utils",
        {"Identification", "Mode and attitude", "Unsolicited telemetry", "Refusals"},
        10,
    ),
    "CANopen": walkthrough_page("2. CANopen", {"With cansend"}, 3),
}


def assert_shown(frame: CanFrame, shown: CanFrame, typed: str) -> None:
    """Compare a frame with the one that a page shows, but for what depends on time and noise."""
    assert (str(frame).partition("#")[0], len(frame.data)) == (
        str(shown).partition("#")[0],
        len(shown.data),
    ), typed
    assert fixed(frame) == fixed(shown), typed
