"""The judge's lines against bytes that public sources publish, and against the product's codec for every unit."""

from __future__ import annotations

import math
import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from starhil.hil_tests.judge import canopen
from starhil.hil_tests.judge.can import frames_of, read_answer
from starhil.hil_tests.judge.definition import Unit, read_unit
from starhil.hil_tests.judge.messages import Answer
from starhil.hil_tests.judge.serial import SerialLine
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.conformance.links import LINKS, write_unit


def definitions() -> dict[str, tuple[InterfaceDefinition, Unit]]:
    """All bundled units, and one for each kind of link that none of them has."""
    with TemporaryDirectory() as folder:
        others = [write_unit(Path(folder) / link, link) for link in LINKS]
        return {Path(name).name: (load_unit(name), read_unit(name)) for name in (*bundled_units(), *others)}


DEFINITIONS = definitions()
ON_SERIAL = [name for name, (_icd, unit) in DEFINITIONS.items() if unit.serial is not None]

CHECKED = [name for name in ON_SERIAL if DEFINITIONS[name][1].serial.check.kind != "none"]


def same(one: object, other: object) -> bool:
    return one == other or (isinstance(one, float) and math.isclose(one, float(str(other)), rel_tol=1e-12))


@pytest.mark.parametrize("name", DEFINITIONS)
def test_rows_have_the_bytes_and_values_of_the_product(name):
    icd, unit = DEFINITIONS[name]
    for row, known in zip(unit.rows, icd.rows, strict=True):
        data = known.encode(known.sample(), check=False)
        seen, wanted = row.decode(data), known.decode(data, check=False)
        assert [key for key in wanted if not same(seen[key], wanted[key])] == [], row
        assert row.encode(seen) == data, row
        assert list(row.faults(data)) == [], row


@pytest.mark.parametrize("name", ON_SERIAL)
@pytest.mark.parametrize("dialect", ["a", "b", "c"])
def test_both_sides_of_the_line_agree_with_the_product(name, dialect):
    icd, unit = DEFINITIONS[name]
    stack, line, rng = SerialStack(icd), SerialLine(unit, dialect), random.Random(5)
    style = None if line.dialect is None else Dialect(line.dialect)
    for row, original in zip(unit.rows, icd.rows, strict=True):
        if row.name in unit.unanswered or row.answers == ("echo",):
            continue
        data = rng.randbytes(row.size)
        request = unit.request(row, b"" if row.is_telemetry else data)
        assert line.encode(request) == stack.encode_request(icd.request(original, request.data)), row
        kind = ReplyKind.TELEMETRY if row.is_telemetry else ReplyKind.ACK
        sent = stack.encode_reply(
            Reply(kind, row.id, data if row.is_telemetry else b"", message_class=row.message_class), style
        )
        echo = line.encode(request) if "echo" in row.answers else b""
        line.expect(request)
        (answer,) = [item for byte in echo + sent for item in line.feed(bytes((byte,)))]
        assert (answer.kind, answer.data if row.is_telemetry else data) == (kind.value, data), row
        assert answer.row_id in (None, row.id)
        refusal = stack.encode_reply(
            Reply(ReplyKind.NACK, row.id, code=ErrorCode.BUSY, message_class=row.message_class), style
        )
        if refusal and not (row.size == 1 and line.dialect in ("a", "b")):
            line.clear()
            line.expect(request)
            (answer,) = line.feed(refusal)
            assert (answer.kind, answer.code) == ("nack", 6 if line.envelope.has_codes else 0), row


@pytest.mark.parametrize("name", CHECKED)
def test_a_changed_byte_is_not_taken_for_the_answer(name):
    icd, unit = DEFINITIONS[name]
    line = SerialLine(unit)
    row = max((item for item in unit.telemetry.values()), key=lambda item: item.size < 40)
    sent = SerialStack(icd).encode_reply(
        Reply(ReplyKind.TELEMETRY, row.id, bytes(range(64, 64 + row.size)), message_class=row.message_class)
    )
    covered = range(len(sent)) if "header" in unit.serial.check.covers else range(6, len(sent) - 2)
    for place in covered:
        line.clear()
        line.expect(unit.request(row))
        damaged = bytearray(sent)
        damaged[place] ^= 0x01
        kinds = {answer.kind for answer in line.feed(bytes(damaged))}
        assert kinds <= {"malformed", "nack"} or bytes(damaged).strip(sent[:1]) == sent.strip(sent[:1]), place


def test_sagitta_reads_as_its_flight_driver_writes():
    """c2a-aobc sagitta.c: C0 21 02 18 XXH32(seed 1425) C0, with C0 as DB DC and DB as DB DD."""
    unit = read_unit("sagitta")
    line = SerialLine(unit)
    sent = line.encode(unit.request(unit.telemetry["solution"]))
    assert sent[:4].hex() == "c0210218"
    assert sent[-1] == 0xC0
    assert line.request_format("")[0].encode(b"\xc0\xdb\x00").hex() == "c0dbdcdbdd00c0"


def test_st200_reads_as_its_flight_driver_does():
    """hyp_st200.c: commands end in CR, READY is a text, F1 begins a record, F0 03 is F3, CRC-8 with polynomial 07."""
    unit = read_unit("st200")
    line, record, command = SerialLine(unit), unit.telemetry["record"], unit.telecommands["set_keep_alive"]
    assert line.encode(unit.request(record)) == b"show record\r"
    assert line.encode(unit.request(command)) == b"set keep-alive off\r"
    frame = bytes.fromhex("f10102") + bytes(8) + bytes.fromhex("f3") + bytes(39) + b"\x07"
    register = 0
    for byte in frame:
        register ^= byte
        for _ in range(8):
            register = (register << 1 ^ (0x107 if register & 0x80 else 0)) & 0xFF
    assert register < 0xF0
    sent = frame.replace(b"\xf3", b"\xf0\x03") + bytes((register,))
    for place in range(len(sent) + 1):
        line.clear()
        line.expect(unit.request(record))
        damaged = sent[:place] + bytes(byte ^ 1 for byte in sent[place : place + 1]) + sent[place + 1 :]
        kinds = [answer.kind for answer in line.feed(damaged)]
        assert kinds == ["telemetry"] if damaged == sent else "telemetry" not in kinds, place
    for text, kind in (
        (b"READY\r\n", "ack"),
        (b"READY \r\n", "malformed"),
        (b"READY\n\r\n", "malformed"),
        (b"ERROR 3\r\n", "nack"),
        (b"ERROR x\r\n", "malformed"),
    ):
        line.clear()
        line.expect(unit.request(command))
        assert [answer.kind for answer in line.feed(text)] == [kind], text


def test_nos3_answers_follow_the_echo_of_the_request():
    """generic_star_tracker_device.c: DEAD id u32 BEEF, echoed; then DEAD u32 BEEF, big-endian."""
    unit = read_unit("nos3")
    line, row = SerialLine(unit), unit.telemetry["housekeeping"]
    sent = line.encode(unit.request(row))
    assert sent.hex() == "dead0100000000beef"
    line.expect(unit.request(row))
    (answer,) = line.feed(sent + bytes.fromhex("dead00000007beef"))
    assert row.decode(answer.data) == {"counter": 7}
    line.expect(unit.request(row))
    assert line.feed(b"\xde\xad\x02" + sent[3:])[0].kind == "malformed"


def test_dialects_read_as_published():
    """AlbertaSat adcs_io.c (a: 6 bytes), RADSAT RCamera.c (b: 5 bytes), libCubeObc (c: 07 and 0F)."""
    unit = read_unit("cubestar")
    row = unit.telecommands["clear_counters"]
    for dialect, accepted, refused in (
        ("a", bytes((0x1F, 0x7F, row.id, 0, 0x1F, 0xFF)), bytes((0x1F, 0x7F, row.id, 3, 0x1F, 0xFF))),
        ("b", b"\x1f\x7f\x00\x1f\xff", b"\x1f\x7f\x03\x1f\xff"),
        ("c", bytes((0x1F, 0x07, row.id, 0x1F, 0xFF)), bytes((0x1F, 0x0F, row.id, 3, 0x1F, 0xFF))),
    ):
        line = SerialLine(unit, dialect)
        for sent, kind, code in ((accepted, "ack", 0), (refused, "nack", 3)):
            line.expect(unit.request(row))
            (answer,) = line.feed(sent)
            assert (answer.kind, answer.code) == (kind, code)


def test_can_frames_are_the_published_vectors():
    """libCubeObc: TC 54 with 12 bytes, TLM 133, TLM 170 with 33 bytes, and a refusal."""
    unit = read_unit("cubestar")
    sent = frames_of(unit.request(54, bytes(range(12))), 1, 4)
    assert [(f"{can_id:08X}", data.hex().upper()) for can_id, data in sent] == [
        ("07360104", "0001020304050601"),
        ("07360104", "0708090A0B00"),
    ]
    assert frames_of(unit.request(133), 1, 4) == [(0x04850104, b"")]
    frames = [CanFrame(0x08AA0401, bytes(7) + bytes((left,))) for left in (4, 3, 2, 1)]
    frames.append(CanFrame(0x08AA0401, bytes(5) + b"\0"))
    following = iter([*frames[1:], None])
    assert read_answer(frames[0], lambda: next(following)) == Answer(
        "telemetry", data=bytes(33), row_id=170, other=1
    )
    following = iter([*frames[2:], None])
    assert read_answer(frames[0], lambda: next(following)).kind == "malformed"
    assert read_answer(CanFrame(0x06850401, b"\x03"), lambda: None) == Answer("nack", 3, row_id=133, other=1)


def test_classes_and_ids_name_the_kind_of_an_unknown_id():
    sagitta = read_unit("sagitta")
    assert sagitta.request(200, message_class="parameter").telemetry
    assert not sagitta.request(200, message_class="action").telemetry
    assert not read_unit("cubestar").request(31).telemetry


TEXT = "410810001a000000", "0041424344454647", "1048494a4b4c4d4e", "004f505152535455", "15565758595a0000"
"""1008h in segments, 26 bytes."""
WRITTEN = "6008100000000000", "2000000000000000", "3000000000000000"


def run_transfer(transfer, *details, responses):
    """Run a transfer with these responses; return what it returns, and its requests."""
    requests, waiting = [], iter(responses)

    def exchange(request):
        requests.append(request.hex())
        return bytes.fromhex(next(waiting))

    return transfer(exchange, *details), requests


@pytest.mark.parametrize(
    ("responses", "data", "requests"),
    [
        (["4318100492010200"], "92010200", ["40181004"]),
        (["4f18100405000000"], "05", ["40181004"]),
        (["4118100402000000", "0b41420000000000"], "4142", ["40181004", "60"]),
    ],
)
def test_an_upload_has_the_bytes_of_cia_301(responses, data, requests):
    assert run_transfer(canopen.upload, 0x1018, 4, responses=responses) == (bytes.fromhex(data), requests)


def test_the_segments_of_an_upload_are_joined():
    data, requests = run_transfer(canopen.upload, 0x1008, 0, responses=TEXT)
    assert data == b"ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    assert requests == ["40081000", "60", "70", "60", "70"]


@pytest.mark.parametrize(
    ("data", "requests"),
    [
        ("e803", ["2b081000e803"]),
        ("00112233445566778899", ["210810000a000000", "0000112233445566", "19778899"]),
    ],
)
def test_a_download_has_the_bytes_of_cia_301(data, requests):
    found = run_transfer(canopen.download, 0x1008, 0, bytes.fromhex(data), responses=WRITTEN)
    assert found == (None, requests)


def test_an_abort_of_a_transfer_has_its_code():
    with pytest.raises(canopen.AbortedError) as caught:
        run_transfer(canopen.upload, 0x1000, 1, responses=["8000100111000906"])
    assert caught.value.code == 0x06090011
    with pytest.raises(canopen.AbortedError):
        run_transfer(canopen.download, 0x1008, 0, bytes(9), responses=[WRITTEN[0], "8008100030000906"])


@pytest.mark.parametrize(
    ("responses", "expected"),
    [
        (["43081000"], "an answer to reading 1008h:00h"),
        (["6008100000000000"], "an answer to reading 1008h:00h"),
        (["4309100000000000"], "an answer to reading 1008h:00h"),
        (["8008100000000000"], "an answer to reading 1008h:00h"),
        ([TEXT[0], TEXT[2]], "a segment of 1008h:00h"),
        ([TEXT[0], "8008100000000008"], "a segment of 1008h:00h"),
        ([*TEXT[:3], TEXT[4].replace("15", "01")], "as many bytes of 1008h:00h as announced"),
    ],
    ids=["short", "command", "object", "abort without code", "toggle", "abort of a segment", "size"],
)
def test_what_a_server_must_not_send_in_an_upload(responses, expected):
    with pytest.raises(canopen.BadResponseError, match=expected):
        run_transfer(canopen.upload, 0x1008, 0, responses=responses)


@pytest.mark.parametrize(
    ("responses", "expected"),
    [
        (["4008100000000000"], "an answer to writing 1008h:00h"),
        (["6009100000000000"], "an answer to writing 1008h:00h"),
        ([WRITTEN[0], WRITTEN[2]], "a confirmed segment of 1008h:00h"),
    ],
    ids=["command", "object", "toggle"],
)
def test_what_a_server_must_not_send_in_a_download(responses, expected):
    with pytest.raises(canopen.BadResponseError, match=expected):
        run_transfer(canopen.download, 0x1008, 0, bytes(9), responses=responses)


def test_entries_of_a_dictionary_follow_from_the_definition():
    """OreSat's 4002h: three numbers, the seconds, a number and a flag; TPDO 5 at 1ADh carries two of them."""
    unit = read_unit("oresat")
    found = {entry.name: entry for entry in canopen.entries(unit, unit.canopen)}
    assert f"{found['4002.attitude_i'].mapping:08X}" == "40020120"
    assert f"{found['4002.attitude_known'].mapping:08X}" == "40020608"
    assert canopen.pdo_can_id(0x2C, 0x1804, unit.canopen.tpdo[4]) == 0x1AD
    assert canopen.pdo_can_id(0x2C, 0x1802, unit.canopen.tpdo[2]) == 0x3AC
