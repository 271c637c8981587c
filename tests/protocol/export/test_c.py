"""The exported C, compiled with all warnings as errors and run under the sanitizers, against our codec and link."""

from __future__ import annotations

import math
import random
import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from starhil.protocol.can.cubespace import CanHostReceiver, encode_reply_frames, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.export.c import prefix_of, render_folder
from starhil.protocol.export.c.rows import is_single
from starhil.protocol.icd import FieldError, InterfaceDefinition, UnknownNameError
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.quoting import c_member
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.emulator.units.clients import Emulated, with_unit
from tests.protocol.export.c_driver import FLAGS, WARNINGS, CDriver, c_words, hex_or_none
from tests.protocol.export.test_export import by_name, packets
from tests.protocol.serial.composed_links import CUBESPACE, CUBESTAR
from tests.test_your_unit import written

pytestmark = pytest.mark.long

ICD = load_unit()
ROWS = [row for row in ICD.rows if row.named_fields]
KINDS = ["none", "telemetry", "ack", "nack", "unsolicited", "event", "burst", "fault"]
FAULT = str(KINDS.index("fault"))


@pytest.fixture(scope="module")
def c(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CDriver]:
    with CDriver(ICD, tmp_path_factory.mktemp("c")) as driver:
        yield driver


@pytest.mark.parametrize("row", ROWS, ids=by_name)
def test_a_row_has_the_same_bytes_and_values_both_ways(c: CDriver, row: Row) -> None:
    for values, data in packets(row):
        words = c_words(row, row.decode(data))
        assert c("decode", row.name, data.hex()) == ["0", *words]
        assert c("encode", row.name, *c_words(row, values)) == ["0", data.hex()]


def refused_at(row: Row, data: bytes) -> int:
    """Position of the value of a telecommand that our codec refuses, from 1; 0 if it takes all."""
    try:
        row.decode(data)
    except FieldError as error:
        return error.index + 1
    return 0


@pytest.mark.parametrize("row", ROWS, ids=by_name)
def test_random_bytes_of_a_row_are_read_and_refused_alike(c: CDriver, row: Row) -> None:
    rng = random.Random(row.id)
    for _ in range(20):
        data = rng.randbytes(row.size)
        if any(field.kind == "text" for field in row.fields):
            data = bytes(byte % 128 or 32 for byte in data)
        result, *words = c("decode", row.name, data.hex())
        words = ["nan" if word == "-nan" else word for word in words]
        assert words == c_words(row, row.decode(data, check=False))
        assert int(result) == refused_at(row, data)
    for size in (row.size - 1, row.size + 1):
        assert c("decode", row.name, hex_or_none(bytes(size))) == ["-1"]


def invalid_at(row: Row, data: bytes) -> int:
    """Position of the first value that is not finite, beyond its limits or in no enumeration, from 1; 0 if all are valid."""
    values = row.decode(data, check=False)
    for index, (name, field) in enumerate(row.named_fields.items(), 1):
        value = values[name]
        if field.enum is not None:
            if not isinstance(value, str | bool):
                return index
        elif field.kind in ("integer", "bits", "float") and (
            not math.isfinite(value)
            or (field.minimum is not None and value < field.minimum)
            or (field.maximum is not None and value > field.maximum)
        ):
            return index
    return 0


@pytest.mark.parametrize("row", ROWS, ids=by_name)
def test_values_that_are_not_valid_are_found_in_what_was_received(c: CDriver, row: Row) -> None:
    rng = random.Random(row.id)
    good = row.encode(row.example())
    assert c("check", row.name, good.hex()) == ["0"]
    for _ in range(20):
        data = bytearray(good)
        data[rng.randrange(row.size)] = rng.choice([0, 0x7F, 0xFF, rng.randrange(256)])
        assert int(c("check", row.name, data.hex())[0]) == invalid_at(row, bytes(data))
    for index, field in enumerate(row.named_fields.values(), 1):
        for number in (math.nan, math.inf, -math.inf):
            if field.kind == "float":
                data = bytearray(good)
                order = "<" if field.slot.order == "little" else ">"
                data[field.offset : field.offset + field.size] = struct.pack(
                    f"{order}{'f' if field.size == 4 else 'd'}", number
                )
                assert c("check", row.name, data.hex()) == [str(index)]


@pytest.mark.parametrize("row", ROWS, ids=by_name)
def test_a_value_beyond_its_limits_is_refused_by_its_position(c: CDriver, row: Row) -> None:
    words = c_words(row, row.example())
    for index, field in enumerate(row.named_fields.values(), 1):
        if field.kind not in ("integer", "bits", "float") or not (
            field.scaled or field.minimum or field.maximum
        ):
            continue
        low, high = field.physical_limits
        for bad in (low - max(abs(low), 1.0), high + max(abs(high), 1.0)):
            if field.scaled or field.kind == "float":
                text = f"{bad:.17g}"
            elif (bad < 0 and not field.type.startswith("i")) or abs(bad) >= 2 ** (8 * field.size - 1):
                continue  # the member cannot hold it
            else:
                text = str(int(bad))
            beyond = (field.minimum is not None and bad < low) or (field.maximum is not None and bad > high)
            if field.kind != "float" or beyond:
                given = [*words[: index - 1], text, *words[index:]]
                assert c("encode", row.name, *given) == [str(index)], field.name


@pytest.mark.parametrize("row", list(ICD.rows), ids=by_name)
def test_requests_are_framed_as_ours(c: CDriver, row: Row) -> None:
    samples = [data for _, data in packets(row)] if row.kind == "telecommand" else [b""]
    for data in [*samples, b"\x1f" * row.size]:
        framed = CUBESPACE.encode_request(Request.of(row.id, data))
        assert c("frame", row.id, hex_or_none(data)) == ["0", framed.hex()]


def events(dialect: Dialect, pending: int | None, data: bytes) -> list[str]:
    """What our receiver of the OBC's side makes of bytes, as the program prints it."""
    receiver = CUBESTAR.host(dialect)
    if pending is not None:
        receiver.overhear(Request.of(pending))
    words: list[str] = []
    for event in receiver.feed(data, 0.0):
        if isinstance(event, LinkFault):
            words += [FAULT, "0", "0", "-"]
        else:
            words += [
                str(KINDS.index(event.kind.value)),
                str(event.id),
                str(int(event.code)),
                hex_or_none(event.data),
            ]
    return [*words, FAULT if receiver.flush(1.0) else "0"]


def c_events(c: CDriver, dialect: Dialect, pending: int | None, data: bytes) -> list[str]:
    return c("receive", list(Dialect).index(dialect), -1 if pending is None else pending, hex_or_none(data))


@pytest.mark.parametrize("dialect", Dialect)
def test_the_receiver_of_the_c_reads_streams_as_ours(c: CDriver, dialect: Dialect) -> None:
    rng = random.Random(7)
    rows = list(ICD.rows)
    for _ in range(400):
        pending = rng.choice([None, 230, 60, 200, *(row.id for row in rows)])
        stream = b""
        for _ in range(rng.randrange(4)):
            row = rng.choice(rows)
            kind = rng.choice([kind for kind in ReplyKind if kind is not ReplyKind.ECHO])
            reply = Reply(
                kind,
                119 if kind is ReplyKind.BURST else rng.choice([row.id, pending or 1]),
                rng.randbytes(22 if kind is ReplyKind.BURST else rng.choice([row.size or 1, 1, 23]))
                if kind not in (ReplyKind.ACK, ReplyKind.NACK)
                else b"",
                code=rng.randrange(1, 11) if kind is ReplyKind.NACK else 0,
            )
            try:
                stream += CUBESPACE.encode_reply(reply, dialect)
            except ProtocolError:
                continue
        damaged = bytearray(stream + rng.randbytes(rng.randrange(3)))
        for _ in range(rng.randrange(4)):
            if damaged:
                damaged[rng.randrange(len(damaged))] = rng.choice(b"\x1f\x7f\xff\x07\x0f\x2f\x4f\x00\x77")
        for data in (stream, bytes(damaged)):
            assert c_events(c, dialect, pending, data) == events(dialect, pending, data), data.hex()


def test_a_message_that_is_too_long_is_one_fault(c: CDriver) -> None:
    data = b"\x1f\x7f\x80" + bytes(600) + b"\x1f\xff"
    assert c_events(c, Dialect.A, 128, data) == events(Dialect.A, 128, data)


# -- CAN ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", list(ICD.rows), ids=by_name)
def test_requests_on_can_are_framed_as_ours(c: CDriver, row: Row) -> None:
    samples = [bytes(range(row.size))] if row.kind == "telecommand" else [b""]
    for data in samples:
        frames = encode_request_frames(Request.of(row.id, data), 1, 4)
        expected = [word for frame in frames for word in (str(frame.id), hex_or_none(frame.data))]
        assert c("can_frame", row.id, hex_or_none(data)) == expected


def test_a_request_on_can_has_as_many_frames_as_its_counter_allows(c: CDriver) -> None:
    for size in (0, 7, 8, 9, 14, 15, 1792):
        data = bytes(number % 251 for number in range(size))
        frames = encode_request_frames(Request.of(9, data), 1, 4)
        assert c("can_frame", 9, hex_or_none(data))[1::2] == [hex_or_none(frame.data) for frame in frames]
    assert c("can_frame", 9, bytes(1793).hex()) == []


def can_events(frames: list[CanFrame]) -> list[list[str]]:
    """What our receiver of the OBC's side makes of each frame, as the program prints it, and of the silence after them."""
    receiver = CanHostReceiver(1, 4)
    values = []
    for frame in frames:
        events = receiver.feed(frame, 0.0)
        messages = [event for event in events if not isinstance(event, LinkFault)]
        words = [FAULT, "0", "0", "-"] if events else []
        for event in messages:
            words = [KINDS.index(event.kind.value), event.id, int(event.code), hex_or_none(event.data)]
        values.append([str(word) for word in words])
    return [*values, [FAULT] if receiver.flush(1.0) else ["0"]]


def test_the_receiver_of_the_c_reads_can_as_ours(c: CDriver) -> None:
    rng = random.Random(11)
    for _ in range(300):
        frames: list[CanFrame] = []
        for _ in range(rng.randrange(1, 5)):
            kind = rng.choice([kind for kind in ReplyKind if kind is not ReplyKind.ECHO])
            short = kind in (ReplyKind.ACK, ReplyKind.NACK)
            data = rng.randbytes(
                0 if short else rng.choice([1, 8] if kind is ReplyKind.EVENT else [1, 8, 9, 22, 70])
            )
            id_ = 119 if kind is ReplyKind.BURST else 128 if kind is ReplyKind.TELEMETRY else 130
            code = rng.randrange(1, 11) if kind is ReplyKind.NACK else 0
            frames += encode_reply_frames(Reply(kind, id_, data, code=code, destination=1), 4)
        damaged = list(frames)
        for _ in range(rng.randrange(4)):
            at = rng.randrange(len(damaged))
            odd = rng.choice([damaged[at].data[:-1], b"", rng.randbytes(8)])
            damaged[at : at + 1] = rng.choice(
                [
                    [],
                    [damaged[at]] * 2,
                    [replace(damaged[at], data=odd)],
                    [replace(damaged[at], id=damaged[at].id ^ 0x100)],
                ]
            ) or [CanFrame(0x1F010401)]
        for sent in (frames, damaged):
            c("can_receive", 0)
            got = [c("can", frame.id, hex_or_none(frame.data)) for frame in sent]
            assert [*got, c("can_give_up", 0)] == can_events(sent), sent


def test_another_row_ends_an_incomplete_message_on_can(c: CDriver) -> None:
    cut, whole = (
        encode_reply_frames(Reply(ReplyKind.TELEMETRY, id_, bytes(size), destination=1), 4)
        for id_, size in ((130, 20), (131, 13))
    )
    c("can_receive", 0)
    got = [c("can", frame.id, hex_or_none(frame.data)) for frame in (cut[0], *whole)]
    assert got == [[], [FAULT, "0", "0", "-"], ["1", "131", "0", bytes(13).hex()]]
    assert c("can_give_up", 0) == ["0"]


def test_a_message_on_can_that_is_too_long_is_one_fault(c: CDriver) -> None:
    frames = encode_reply_frames(Reply(ReplyKind.TELEMETRY, 130, bytes(600), destination=1), 4)
    c("can_receive", 0)
    got = [c("can", frame.id, hex_or_none(frame.data)) for frame in frames]
    assert [*got, c("can_give_up", 0)] == can_events(frames)
    assert sum(FAULT in words for words in got) == 1


def test_every_row_is_answered_by_the_emulated_unit_on_can(c: CDriver) -> None:
    def ask(unit: Emulated, row: Row, data: bytes) -> list[str]:
        c("can_receive", 0)
        words = c("can_frame", row.id, hex_or_none(data))
        answer: list[CanFrame] = []
        for can_id, hexed in zip(words[::2], words[1::2], strict=True):
            answer += unit.ask_can(int(can_id), bytes.fromhex(hexed.strip("-")))
        *none, last = [c("can", frame.id, hex_or_none(frame.data)) for frame in answer]
        assert none == [[]] * len(none)
        return last

    def scenario(unit: Emulated) -> None:
        for row in ICD.telemetry.values():
            kind, id_, _, data = ask(unit, row, b"")
            assert (KINDS[int(kind)], int(id_), len(data) // 2) == ("telemetry", row.id, row.size), row.name
        for row in ICD.telecommands.values():
            kind, id_, *_ = ask(unit, row, row.encode(row.example()))
            assert (KINDS[int(kind)] in ("ack", "nack"), int(id_)) == (True, row.id), row.name

    with_unit("cubestar", "can", scenario)


# -- other units -------------------------------------------------------------------------------------------------------


def kinds(row: Row) -> set[tuple[object, ...]]:
    return {(row.kind, each.kind, each.type, each.scaled, is_single(each)) for each in row.fields}


def one_of_each_kind(icd: InterfaceDefinition) -> InterfaceDefinition:
    """The definition with those rows only that have a field of a kind which no row before has, nor a unit that is compiled whole."""
    seen = {
        kind for unit in ("cubestar", "nos3", "st16") for row in load_unit(unit).rows for kind in kinds(row)
    }
    names = []
    for row in icd.rows:
        if not kinds(row) <= seen:
            names.append(row.name)
        seen |= kinds(row)
    return icd.with_rows(names)


@pytest.mark.parametrize("name", ["nos3", "st16", "tutorial"])
def test_the_rows_of_a_unit_have_the_same_bytes_and_values_both_ways(name: str, tmp_path: Path) -> None:
    both_ways(load_unit(written(tmp_path / "lynx") if name == "tutorial" else name), tmp_path, FLAGS)


@pytest.mark.parametrize("flags", [WARNINGS, FLAGS], ids=["all rows", "sanitizers"])
@pytest.mark.parametrize("name", ["sagitta", "cubestar-gen2"])
def test_the_rows_of_a_large_unit_have_the_same_bytes_and_values_both_ways(
    name: str, flags: list[str], tmp_path: Path
) -> None:
    """With sanitizers the code of all rows would be compiled for a quarter of a minute."""
    icd = load_unit(name)
    both_ways(one_of_each_kind(icd) if flags == FLAGS else icd, tmp_path, flags)


def both_ways(icd: InterfaceDefinition, folder: Path, flags: list[str]) -> None:
    rng = random.Random(icd.name)
    with CDriver(icd, folder, flags=flags) as driver:
        for row in (row for row in icd.rows if row.named_fields):
            for values, data in packets(row):
                assert driver("decode", row.name, data.hex()) == ["0", *c_words(row, row.decode(data))]
                assert driver("encode", row.name, *c_words(row, values)) == ["0", data.hex()], row.name
            if any(field.kind in ("float", "text") for field in row.fields):
                continue
            data = rng.randbytes(row.size)
            result, *words = driver("decode", row.name, data.hex())
            assert (int(result), words) == (
                refused_at(row, data),
                c_words(row, row.decode(data, check=False)),
            )


def test_only_the_chosen_rows_have_code(tmp_path: Path) -> None:
    header, source = render_folder(ICD, ["set_mode", "precise_attitude"]).values()
    written_rows = set(re.findall(r"\bcubestar_(?:tc|tlm)_(\w+)_encode\b", header + source))
    assert written_rows == {"set_mode", "precise_attitude"}
    whole = "".join(render_folder(ICD).values())
    assert len(header + source) < 0.2 * len(whole)
    with CDriver(ICD.with_rows(["set_mode", "precise_attitude"]), tmp_path) as driver:
        row = ICD.telemetry["precise_attitude"]
        for values, data in packets(row):
            assert driver("encode", row.name, *c_words(row, values)) == ["0", data.hex()]
    with pytest.raises(UnknownNameError, match="did you mean precise_attitude"):
        render_folder(ICD, ["precise_atitude"])


@pytest.mark.parametrize("name", ["cubestar", "cubestar-gen2"])
def test_a_member_is_a_double_only_if_a_float_would_round_its_steps(name: str) -> None:
    icd = load_unit(name)
    header, _ = render_folder(icd).values()
    prefix = prefix_of(icd)
    counts = Counter[bool]()
    for row in icd.rows:
        kind = "tc" if row.kind == "telecommand" else "tlm"
        members = re.search(rf"typedef struct {{([^}}]*)}} {prefix}_{kind}_{row.name}_t;", header)
        for field in row.named_fields.values():
            if field.scaled and field.kind != "float" and members is not None:
                largest = max(abs(float(field.to_physical(limit))) for limit in field.raw_limits)
                roundings = abs(field.scale) / float(np.spacing(np.float32(max(largest, abs(field.bias)))))
                double = f"double {c_member(field.name)};" in members[1]
                assert roundings < 256 if double else roundings > 32, (row.name, field.name)
                counts[double] += 1
    assert counts[False] > 50


@pytest.mark.parametrize("name", ["cubestar", "st16", "cubestar-gen2"])
def test_the_introduction_of_the_header_breaks_lines_only_where_they_are_full(name: str) -> None:
    unit = load_unit(name)
    introduction = render_folder(unit)[f"{prefix_of(unit)}.h"].partition(" */")[0]
    for paragraph in re.split(r"\n \*\n", introduction.removeprefix("/* ")):
        lines = paragraph.removeprefix(" * ").split("\n * ")
        for line, following in pairwise(lines):
            assert len(f"{line} {following.split()[0]}") > 100


def test_the_header_has_version_and_checksum_of_the_definition() -> None:
    icd = load_unit("sagitta")
    header = next(text for name, text in render_folder(icd).items() if name.endswith(".h"))
    prefix = prefix_of(icd).upper()
    assert f'#define {prefix}_DEFINITION_VERSION "{icd.version}"' in header
    (checksum,) = re.findall(rf"#define {prefix}_DEFINITION_CRC32 (0x[0-9A-F]{{8}})u", header)
    assert next(iter(render_folder(icd).values())) == header
    other = replace(icd, version="another")
    (changed,) = re.findall(r"DEFINITION_CRC32 (0x[0-9A-F]{8})u", next(iter(render_folder(other).values())))
    assert changed != checksum
