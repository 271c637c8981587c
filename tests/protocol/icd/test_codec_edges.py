"""Limits and scales of fields and parameters at their edges."""

import asyncio
import math
import socket
import struct

import pytest

from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.can.cubespace import encode_reply_frames
from starhil.protocol.can.socketcand import CommandError, parse_can_id, parse_frame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import FieldError, UnknownNameError
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.values import to_f32
from starhil.protocol.image_transfer import MAP_PART_SIZE, MAX_PACKETS, HoleMap
from starhil.protocol.messages import Reply, ReplyKind, RequestKind
from starhil.protocol.transports.connections import detect_lost_peer
from starhil.protocol.unit import load_unit

UNIT = """
[unit]
name = "edges"
version = "1"
doc = "d"

[link.serial]
framing = { kind = "cubespace" }

[[telecommand]]
id = 1
name = "set"
doc = "d"
provenance = "ours"
action = "nothing"
fields = [
    { name = "single", type = "f32", min = -1, max = 2.5 },
    { name = "double", type = "f64" },
    { name = "centi", type = "u16", scale = 0.01 },
]

[[telecommand]]
id = 2
name = "label"
doc = "d"
provenance = "ours"
action = "nothing"
fields = [{ name = "text", type = "text", size = 4 }]

[[telecommand]]
id = 3
name = "turn"
doc = "d"
provenance = "ours"
action = "nothing"
fields = [{ name = "angle", type = "f32", scale = 0.5, offset = 10, min = -10, max = 30 }]

[[telecommand]]
id = 4
name = "walk"
doc = "d"
provenance = "ours"
action = "nothing"
fields = [{ name = "step", type = "i16", scale = 2.5, offset = 1 }]
"""


@pytest.fixture
def icd(tmp_path):
    (tmp_path / "unit.toml").write_text(UNIT)
    return load_unit(tmp_path / "unit.toml")


@pytest.mark.parametrize("value", [-1.5, 3.0])
def test_a_float_outside_its_limits_is_refused_when_received(icd, value):
    row = icd.telecommands["set"]
    data = row.encode({"single": value, "double": 0.0, "centi": 0.0}, check=False)
    with pytest.raises(FieldError, match="outside"):
        row.decode(data)


@pytest.mark.parametrize("field", ["single", "double", "centi"])
@pytest.mark.parametrize("digits", [400, 20_000])
def test_a_whole_number_beyond_all_floats_is_rejected(icd, field, digits):
    values = {"single": 0.0, "double": 0.0, "centi": 0.0, field: -(16**digits)}
    with pytest.raises(
        FieldError, match=rf"set.{field}: a whole number of {4 * digits + 1} bits fits no field"
    ):
        icd.telecommands["set"].encode(values)


@pytest.mark.parametrize(
    ("value", "raw", "read"), [(11.0, 2.0, 11.0), (-99.0, -40.0, -10.0), (99.0, 40.0, 30.0)]
)
def test_a_float_is_scaled_and_sent_as_the_nearest_limit(icd, value, raw, read):
    row = icd.telecommands["turn"]
    data = row.encode({"angle": value}, saturate=True)
    assert struct.unpack("<f", data) == (raw,)
    assert row.decode(data) == {"angle": read}


def test_a_double_without_limits_may_exceed_single_precision(icd):
    row = icd.telecommands["set"]
    data = row.encode({"single": 0.0, "double": 1e300, "centi": 0.0})
    assert row.decode(data)["double"] == 1e300


@pytest.mark.parametrize("raw", [7, 29, 57, 115])
def test_a_scaled_number_is_the_nearest_decimal_number(icd, raw):
    row = icd.telecommands["set"]
    assert row.named_fields["centi"].to_physical(raw) == raw / 100


@pytest.mark.parametrize(("raw", "step"), [(0, 1.0), (3, 8.5), (-32768, -81919.0)])
def test_a_whole_number_is_multiplied_by_its_scale_and_moved_by_its_offset(icd, raw, step):
    row = icd.telecommands["walk"]
    assert row.encode({"step": step}) == struct.pack("<h", raw)
    assert row.decode(struct.pack("<h", raw)) == {"step": step}


def test_an_enumeration_and_a_flag_limit_their_parameters():
    parameters = load_unit("cubestar").parameters.values()
    chosen = [item for item in parameters if item.enum is not None]
    assert chosen
    for item in chosen:
        numbers = item.enum.values.values()
        assert (item.minimum, item.maximum) == (min(numbers), max(numbers))
    flags = [(item.minimum, item.maximum) for item in parameters if item.type == "bool"]
    assert set(flags) == {(0.0, 1.0)}


def test_the_first_and_the_last_packet_are_marked_and_none_beyond():
    arrived = HoleMap.of([0, MAX_PACKETS - 1, MAX_PACKETS, -1])
    assert 0 in arrived
    assert MAX_PACKETS - 1 in arrived
    assert MAX_PACKETS not in arrived
    assert sum(number in arrived for number in range(MAX_PACKETS)) == 2


@pytest.mark.parametrize("must_read", [False, True])
def test_only_a_server_gives_up_a_peer_that_does_not_read(must_read):
    async def time_out() -> int:
        server = await asyncio.start_server(lambda _reader, writer: writer.close(), "127.0.0.1", 0)
        _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        detect_lost_peer(writer.transport, **({"must_read": True} if must_read else {}))
        connection = writer.get_extra_info("socket")
        value = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
        writer.close()
        server.close()
        return value

    assert (asyncio.run(time_out()) > 0) is must_read


@pytest.mark.parametrize(
    ("row", "values", "message"),
    [
        ("label", {"text": "Ωmega"}, "label.text: 'Ωmega' is not ASCII text"),
        ("label", {"text": 7}, "label.text: 7 is not ASCII text"),
        ("label", {"text": "abcde"}, "label.text: 5 characters, at most 4"),
        ("set", {"single": 1e39, "double": 0.0, "centi": 0.0}, "set.single: 1e[+]39 is outside -1 to 2.5"),
        ("set", {"single": 0.0, "double": 0.0, "centi": math.inf}, "set.centi: inf is outside 0 to 655.35"),
    ],
)
def test_what_no_field_can_hold_is_rejected_even_without_checks(icd, row, values, message):
    with pytest.raises(FieldError, match=message):
        icd.telecommands[row].encode(values, check=False)


@pytest.mark.parametrize(
    ("value", "single"), [(1e39, math.inf), (-1e39, -math.inf), (0.1, 0.10000000149011612)]
)
def test_a_number_beyond_single_precision_is_infinite(value, single):
    assert to_f32(value) == single


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: encode_reply_frames(Reply(ReplyKind.ECHO, 1), 4), "CAN has no echo messages"),
        (lambda: encode_reply_frames(Reply(ReplyKind.TELEMETRY, None), 4), "a telemetry on CAN needs an ID"),
        (lambda: encode_reply_frames(Reply(ReplyKind.EVENT, 5, bytes(9)), 4), "of 9 bytes does not fit one CAN frame"),
        (lambda: HoleMap().with_part(1, bytes(15)), f"hole map part of 15 bytes, must be {MAP_PART_SIZE}"),
        (lambda: HoleMap().part(0), "hole map part 0 is outside 1 to 8"),
        (lambda: parse_frame(b"frame 123 nan 00"), "malformed frame: frame 123 nan 00"),
        (lambda: parse_can_id(b"1234"), "CAN ID 1234 has neither"),
    ],
)  # fmt: skip
def test_what_no_message_can_hold_is_rejected(call, message):
    with pytest.raises((ProtocolError, CommandError), match=message):
        call()


def test_a_can_id_with_unknown_flags_above_29_bits_is_read_without_them():
    assert parse_can_id(b"80000123") == (True, False, 0x123)
    assert parse_can_id(b"C0000123") == (True, True, 0x123)


@pytest.mark.parametrize(
    ("message_class", "row_id", "found", "kind"),
    [
        (None, 6, "set", RequestKind.TELECOMMAND),  # the first row with this ID
        ("parameter", 6, "parameter", RequestKind.TELEMETRY),
        (None, 250, "set", RequestKind.TELECOMMAND),  # no row: the first class
    ],
)
def test_a_request_by_id_has_the_class_of_its_row(message_class, row_id, found, kind):
    request = load_unit("sagitta").request_of(row_id, message_class, b"\1")
    assert (request.message_class, request.kind, request.id, request.data) == (found, kind, row_id, b"\1")


def test_a_request_of_an_unknown_class_is_rejected_and_a_unit_without_classes_needs_none():
    with pytest.raises(UnknownNameError, match="no class named 'write'; the unit has set, parameter, "):
        load_unit("sagitta").request_of(6, "write")
    assert load_unit("cubestar").request_of(160).kind is RequestKind.TELEMETRY


@pytest.mark.parametrize(
    ("epoch", "unix_s"), [("2000-01-01", 946_684_800), ("2000-01-01T02:00:00+02:00", 946_684_800)]
)
def test_an_epoch_without_a_time_zone_is_utc(epoch, unix_s):
    assert Conventions(epoch=epoch).epoch_ns == unix_s * 10**9


@pytest.mark.parametrize("module", ["codec", "judge"])
def test_numbers_that_a_map_assigns_to_true_and_false_are_a_flag(module):
    """A unit with `map = { 7 = true, 5 = false }`; the names are accepted too."""
    row = load_unit("cubestar-gen2").telemetry["raw_cubestar"]
    if module == "judge":
        row = read_unit("cubestar-gen2").telemetry["raw_cubestar"]
    name = "str0_identification"
    for value, given in ((True, True), (True, "true"), (False, False), (False, "false")):
        data = row.encode(
            row.decode(bytes(row.size)) | {name: given}, **({"check": False} if module == "codec" else {})
        )
        assert row.decode(data)[name] is value
    assert row.decode(bytes(row.size))[name] == 0
