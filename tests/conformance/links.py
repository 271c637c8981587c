"""A unit for each kind of serial link that no bundled unit has, with rows of every type of field."""

from __future__ import annotations

from pathlib import Path
from typing import Final

LINKS: Final = {
    "sum": """
framing = { kind = "length", start = [0xEB, 0x90] }
check = { kind = "sum", type = "u16", complement = "twos", covers = ["start", "header", "data"] }
request_header = [{ role = "length", type = "u16" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u16" }, { role = "id", type = "u8" }, { role = "status", type = "u8" }]
""",
    "xor": """
framing = { kind = "length", start = [0x55], end = [0xAA] }
check = { kind = "xor", init = 0x5A, covers = ["data"] }
request_header = [
    { role = "id", type = "u8" },
    { role = "length", type = "u16", order = "big", includes = ["start", "header", "data", "check", "end"] },
]
reply_header = [
    { role = "id", type = "u8" }, { role = "length", type = "u16", order = "big", includes = ["header", "data"] },
    { role = "status", type = "i8" },
]
""",
    "dle": """
framing = { kind = "escaped" }
check = { kind = "crc", type = "u32", poly = 0x04C11DB7, init = 0xFFFFFFFF, reflect = true, xor = 0xFFFFFFFF }
request_header = [{ role = "id", type = "u8" }, { type = "u8", const = 0x10 }]
reply_header = [
    { role = "id", type = "u8" },
    { type = "bits8", bits = [{ width = 2, const = 1 }, { role = "ack" }, { width = 4 }, { role = "final" }] },
]
""",
    "hex": """
framing = { kind = "delimited", start = [0x24], end = [0x0D, 0x0A], encoding = "hex" }
check = { kind = "xor" }
request_header = [{ role = "address", type = "u16", default = 0x1234 }, { role = "id", type = "u8" }]
reply_header = [
    { role = "address", type = "u16", default = 0x1234 }, { role = "id", type = "u8" }, { role = "status", type = "u8" },
]
""",
    "xor16": """
framing = { kind = "length", start = [0x5A] }
check = { kind = "xor", type = "u16", init = 0x1234 }
request_header = [{ role = "length", type = "u24" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u24" }, { role = "id", type = "u8" }, { role = "status", type = "u8" }]
""",
    "fletcher": """
framing = { kind = "length", start = [0x5A] }
check = { kind = "fletcher16" }
request_header = [{ role = "id", type = "u8" }, { role = "length", type = "u16", offset = 1 }]
reply_header = [
    { role = "id", type = "u8" }, { role = "length", type = "u16", offset = 1 },
    { role = "sequence", type = "u8", counts = ["reply"] }, { role = "status", type = "u8" },
]
""",
    "hdlc": """
framing = { kind = "slip", end = 0x7E, escape = 0x7D, xor = 0x20 }
check = { kind = "crc", type = "u16", poly = 0x1021, init = 0xFFFF, reflect = true, xor = 0xFFFF, order = "big" }
request_header = [{ role = "id", type = "u8" }]
reply_header = [{ role = "id", type = "u8" }, { role = "status", type = "u8" }]
""",
    "stuffed": """
framing = { kind = "length", start = [0xF1], stuffing = { escape = 0xF0, mask = 0x0F } }
check = { kind = "crc", type = "u8", poly = 0x07, covers = ["start", "header", "data"] }
request_header = [{ role = "length", type = "u16" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u16" }, { role = "id", type = "u8" }, { role = "status", type = "u8" }]
""",
    "formats": """
framing = { kind = "delimited", start = [0x24], end = [0x0D, 0x0A], encoding = "hex" }
check = { kind = "xor" }
request_header = [{ role = "length", type = "u16" }, { role = "id", type = "u8" }]
reply_header = [
    { role = "length", type = "u16", includes = ["header", "data", "check"] },
    { role = "id", type = "u8" }, { role = "status", type = "u8" },
]

[[link.serial.format]]
direction = "reply"
framing = { kind = "length", start = [0xEB, 0x90] }
check = { kind = "crc", type = "u16", poly = 0x1021, init = 0xFFFF }
""",
}
ROWS: Final = """
[unit]
name = "{name}"
version = "1"
doc = "Rows of every type of field on another link."
first_telemetry_id = 128
provenance = "ours"

[conventions]
byte_order = "{order}"

[[parameter]]
id = 1
name = "start_mode"
default = "lost_in_space"

[[telecommand]]
id = 1
name = "set_numbers"
doc = "Numbers with limits."
action = "nothing"
fields = [
    {{ name = "a", type = "u8", min = 10, max = 240, default = 20 }},
    {{ name = "b", type = "i16", scale = 0.01, min = -150, max = 250, default = 0 }},
    {{ name = "c", type = "u32", min = 3, max = 4000000000, default = 3 }},
    {{ name = "d", type = "f32", min = -2.5, max = 2.5, default = 0 }},
    {{ name = "e", type = "u16", scale = -0.5, offset = 100, min = -1000, max = 50, default = 0 }},
    {{ name = "f", type = "f64", min = 0, max = 1e9, default = 0 }},
    {{ name = "g", type = "i64", min = -5, max = 5, default = 0 }},
    {{ name = "h", type = "i24", scale = 0.5, min = -4000000, max = 4000000, default = 0 }},
    {{ name = "i", type = "u24", order = "little", min = 1, max = 0x123456, default = 1 }},
    {{ type = "bits16", bits = [{{ name = "flag", default = false }}, {{ name = "group", width = 5, default = 3 }}, {{ width = 10 }}] }},
]

[[telecommand]]
id = 2
name = "set_time"
doc = "Set the clock."
action = "set_clock"
fields = [
    {{ name = "seconds", type = "u32", unit = "s", argument = "seconds" }},
    {{ name = "nanoseconds", type = "u32", unit = "ns", max = 999999999, argument = "nanoseconds" }},
]

[[telemetry]]
id = 128
name = "numbers"
doc = "As set."
include = ["set_numbers"]

[[telemetry]]
id = 129
name = "attitude"
doc = "Attitude in double precision."
fields = [
    {{ name = "x", type = "f64", value = "attitude.x" }}, {{ name = "y", type = "f64", value = "attitude.y" }},
    {{ name = "z", type = "f64", value = "attitude.z" }}, {{ name = "w", type = "f64", value = "attitude.w" }},
    {{ name = "valid", type = "u8", value = "attitude.valid", map = {{ 0 = false, 1 = true }} }},
    {{ name = "detected", type = "u16", value = "stars.detected" }},
    {{ name = "boots", type = "u32", value = "boot.count" }},
]

[[telemetry]]
id = 130
name = "short_attitude"
doc = "Attitude in integers."
fields = [
    {{ name = "x", type = "i16", scale = 5e-5, value = "attitude.x" }}, {{ name = "y", type = "i16", scale = 5e-5, value = "attitude.y" }},
    {{ name = "z", type = "i32", scale = 5e-8, value = "attitude.z" }}, {{ name = "w", type = "u16", scale = 4e-5, offset = -1.2, value = "attitude.w" }},
    {{ type = "bits8", bits = [{{ width = 2 }}, {{ name = "valid", value = "attitude.valid" }}, {{ width = 5 }}] }},
    {{ type = "bits16", bits = [{{ width = 3 }}, {{ name = "detected", width = 7, value = "stars.detected" }}, {{ width = 6 }}] }},
    {{ name = "boots", type = "u8", value = "boot.count" }},
    {{ name = "z_24", type = "i24", scale = 2.5e-7, value = "attitude.z" }},
    {{ name = "detected_24", type = "u24", order = "little", value = "stars.detected" }},
]

[link.serial]
"""


def write_unit(folder: Path, link: str, order: str = "big") -> Path:
    """Write the unit with one of the links; return its folder."""
    folder.mkdir(exist_ok=True)
    (folder / "unit.toml").write_text(ROWS.format(name=link, order=order) + LINKS[link], encoding="utf-8")
    return folder
