"""What the judge takes from the product's reader of definitions: entries expanded to fields, against fields worked out by hand.

An error in this expansion is in product and judge alike, so that no case can see it; these vectors can.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from starhil.hil_tests.judge.definition import read_unit
from starhil.hil_tests.judge.rows import Field

HEAD = """
[unit]
name = "x"
version = "1"
doc = "d"
[conventions]
byte_order = "little"
[[telemetry]]
id = 1
name = "part"
doc = "d"
provenance = "ours"
fields = ["u8 first", "i16 second V 0.5"]
"""
ROW = """
[[telemetry]]
id = 2
name = "row"
doc = "d"
provenance = "ours"
"""
BIG = HEAD.replace('"little"', '"big"')
OMITTED = HEAD.replace('byte_order = "little"\n', "")

VECTORS = {
    "a text is a number with unit and scale": (
        HEAD,
        'fields = ["i16 a uT 0.01", "f32 b"]',
        [
            "a integer i16 at 0 x 0.01 uT",
            "b float f32 at 2",
        ],
    ),
    "braces are numbered from left to right, the last one fastest": (
        HEAD,
        'fields = ["u8 m{0,1}_{x,y}", "u16 c{8..10}"]',
        [
            "m0_x integer u8 at 0",
            "m0_y integer u8 at 1",
            "m1_x integer u8 at 2",
            "m1_y integer u8 at 3",
            "c8 integer u16 at 4",
            "c9 integer u16 at 6",
            "c10 integer u16 at 8",
        ],
    ),
    "bits of a text fill bytes from the lowest bit on": (
        HEAD,
        'fields = ["u8 -", "bits a:4 b{0..2} - c:8"]',
        [
            "- unused u8 at 0",
            "a bits u8 at 1.0:4",
            "b0 flag u8 at 1.4:1",
            "b1 flag u8 at 1.5:1",
            "b2 flag u8 at 1.6:1",
            "- unused u8 at 1.7:1",
            "c bits u8 at 2.0:8",
        ],
    ),
    "strings have their sizes": (
        HEAD,
        'fields = ["bytes a 3", "text b 2", "u8 c"]',
        [
            "a bytes bytes at 0",
            "b text bytes at 3",
            "c integer u8 at 5",
        ],
    ),
    "count numbers a field from 1 on": (
        HEAD,
        'fields = [{ name = "a", type = "u16", count = 2 }]',
        [
            "a_1 integer u16 at 0",
            "a_2 integer u16 at 2",
        ],
    ),
    "repeat interleaves its fields": (
        HEAD,
        'fields = [{ repeat = { count = 2, fields = [{ name = "a", type = "u8" }, { name = "b", type = "u16" }] } }]',
        [
            "a_1 integer u8 at 0",
            "b_1 integer u16 at 1",
            "a_2 integer u8 at 3",
            "b_2 integer u16 at 4",
        ],
    ),
    "include is in front": (
        HEAD,
        'include = ["part"]\nfields = ["u8 third"]',
        [
            "first integer u8 at 0",
            "second integer i16 at 1 x 0.5 V",
            "third integer u8 at 3",
        ],
    ),
    "a map is an enumeration": (
        HEAD,
        'fields = [{ name = "a", type = "u8", map = { 7 = "on", 0x10 = "off" } }]',
        [
            "a enum u8 at 0",
        ],
    ),
    "the byte order of the unit, unless a field has its own": (
        BIG,
        'fields = [{ name = "a", type = "u16" }, { name = "b", type = "u16", order = "little" }]',
        [
            "a integer u16 at 0 big",
            "b integer u16 at 2",
        ],
    ),
    "an omitted byte order is little-endian": (
        OMITTED,
        'fields = ["u32 a"]',
        [
            "a integer u32 at 0",
        ],
    ),
}
"""A case: start of the unit, fields of its row, and these expanded; see `described`."""


def described(item: Field) -> str:
    """Return a field as `name kind type at offset.bit:width order x scale unit`, without bits, little-endian order and scale 1."""
    bits = f".{item.shift}:{item.width}" if item.width or item.shift else ""
    order = "" if item.order == "little" else f" {item.order}"
    scale = "" if item.scale == 1.0 else f" x {item.scale:g}"
    return f"{item.name or '-'} {item.kind} {item.type} at {item.offset}{bits}{order}{scale} {item.unit}".rstrip()


@pytest.mark.parametrize("vector", VECTORS)
def test_an_entry_expands_to_the_fields_worked_out_by_hand(tmp_path: Path, vector: str) -> None:
    head, fields, expected = VECTORS[vector]
    (tmp_path / "unit.toml").write_text(head + ROW + fields, encoding="utf-8")
    assert [described(item) for item in read_unit(tmp_path).telemetry["row"].fields] == expected


def test_the_numbers_of_a_map_and_their_names(tmp_path: Path) -> None:
    fields = 'fields = [{ name = "a", type = "u8", map = { 7 = "on", 0x10 = "off" } }]'
    (tmp_path / "unit.toml").write_text(HEAD + ROW + fields, encoding="utf-8")
    (item,) = read_unit(tmp_path).telemetry["row"].fields
    assert item.enum == {"on": 7, "off": 16}


def test_an_entry_with_several_ids_is_a_row_for_each_with_the_number_of_its_quantity(tmp_path: Path) -> None:
    row = ROW.replace("id = 2", "id = 2\nlast_id = 4").replace('"row"', '"star"')
    text = 'fields = [{ name = "x", type = "f32", unit = "px", value = "stars[n].x" }]'
    (tmp_path / "unit.toml").write_text(HEAD + row + text, encoding="utf-8")
    rows = read_unit(tmp_path).telemetry
    assert {(row.id, row.name, row.fields[0].value) for row in rows.values() if row.id > 1} == {
        (2, "star_1", "stars[1].x"),
        (3, "star_2", "stars[2].x"),
        (4, "star_3", "stars[3].x"),
    }
