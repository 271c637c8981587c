"""Definitions as users write them: packets that are only sent, and rows that a unit without classes streams."""

from __future__ import annotations

from pathlib import Path
from typing import Final

HEAD: Final = """
[unit]
name = "user"
version = "1"
doc = "A user's unit."
provenance = "ours"

[conventions]
byte_order = "big"

[[parameter]]
id = 1
name = "start_mode"
default = "lost_in_space"
"""
ATTITUDE: Final = """
[[telemetry]]
id = ID
name = "attitude"
doc = "d"
KEYS
fields = [
    { name = "w", type = "f64", value = "attitude.w" }, { name = "x", type = "f64", value = "attitude.x" },
    { name = "y", type = "f64", value = "attitude.y" }, { name = "z", type = "f64", value = "attitude.z" },
    { name = "valid", type = "u8", value = "attitude.valid", map = { 0 = false, 1 = true } },
]
"""
PACKET: Final = """[
    { type = "bits16", bits = [
        { role = "id", width = 11 }, { width = 1, const = 0 }, { role = "class", width = 1 }, { width = 3, const = 0 },
    ] },
    { type = "bits16", bits = [{ role = "sequence", width = 14, COUNTS }, { width = 2, const = 3 }] },
    { role = "length", type = "LENGTH", includes = ["data"], offset = -1 },
]"""
PACKETS: Final = (
    HEAD
    + """
[[class]]
name = "command"
kind = "telecommand"
code = 1
answer = ["row:verification"]

[[class]]
name = "telemetry"
kind = "telemetry"
code = 0

[[telecommand]]
id = 0x100
name = "set_time"
doc = "d"
action = "set_clock"
fields = [{ name = "seconds", type = "u32", unit = "s", argument = "seconds" }]

[[telemetry]]
id = 0x101
name = "verification"
doc = "Result of the last telecommand."
request = false
fields = [{ name = "last", type = "u16", value = "request.last" }]
"""
    + ATTITUDE.replace("ID", "0x102").replace("KEYS", "request = false\nunsolicited = 2.0")
    + f"""
[link.serial]
framing = {{ kind = "length", start = [0x1A, 0xCF, 0xFC, 0x1D] }}
check = {{ kind = "crc", type = "u16", poly = 0x1021, init = 0xFFFF }}
request_header = {PACKET.replace(", COUNTS", "")}
reply_header = {PACKET.replace("COUNTS", 'counts = ["reply", "unsolicited"]')}
"""
)
"""Space packets (CCSDS 133.0-B): a length less 1, telemetry that no packet requests; `LENGTH` is its type."""
STATUS: Final = """
[[telemetry]]
id = 2
name = "status"
doc = "d"
fields = [
    { name = "uptime", type = "u32", unit = "ms", value = "uptime" },
    { name = "clock", type = "f64", unit = "s", value = "clock.unix" },
    { name = "asked", type = "u16", value = "counters.telemetry" },
    { name = "commanded", type = "u16", value = "counters.telecommands" },
    { name = "frames", type = "u32", value = "frame.counter" },
    { name = "frame_time", type = "f64", unit = "s", value = "frame.time" },
]
"""
STREAM: Final = (
    HEAD
    + """
[[telecommand]]
id = 1
name = "stream"
doc = "d"
action = "subscribe"
fields = [{ name = "row", type = "u8", argument = "telemetry[1]" }]

[[telecommand]]
id = 4
name = "ping"
doc = "d"
action = "nothing"
"""
    + STATUS
    + ATTITUDE.replace("ID", "3").replace("KEYS", "")
    + """
[link.serial]
framing = { kind = "length", start = [0xEB, 0x90] }
check = { kind = "sum", type = "u8" }
request_header = [{ role = "length", type = "u8" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u8" }, { role = "id", type = "u8" }, { role = "status", type = "u8" }]
"""
)
"""A unit without classes whose streamed rows look like answers, and whose length is one byte."""

ON_CAN: Final = (
    HEAD
    + """
[[telecommand]]
id = 4
name = "ping"
doc = "d"
action = "nothing"
answer = ["reply", "row:status"]
"""
    + STATUS.replace("id = 2", "id = 130")
    + ATTITUDE.replace("ID", "131").replace("KEYS", 'request = false\nunsolicited = ["frame"]')
    + """
[link.can]
kind = "cubespace"
[link.serial]
framing = { kind = "cubespace" }
"""
)
"""CubeSpace's links, on which a telecommand is answered by a row too, and a row comes with each frame."""


def packets(length: str = "u16") -> str:
    """Return the unit of space packets with a length of a type."""
    return PACKETS.replace("LENGTH", length)


def written(folder: Path, text: str) -> Path:
    """Write a unit in one file into a folder; return the folder."""
    folder.mkdir(exist_ok=True)
    (folder / "unit.toml").write_text(text, encoding="utf-8")
    return folder
