"""Limits and scales of fields and parameters at their edges."""

import asyncio
import socket

import pytest

from starhil.protocol.flow import detect_lost_peer
from starhil.protocol.icd import load_unit
from starhil.protocol.image_transfer import MAX_PACKETS, HoleMap
from starhil.protocol.values import FieldError

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


def test_a_double_without_limits_may_exceed_single_precision(icd):
    row = icd.telecommands["set"]
    data = row.encode({"single": 0.0, "double": 1e300, "centi": 0.0})
    assert row.decode(data)["double"] == 1e300


@pytest.mark.parametrize("raw", [7, 29, 57, 115])
def test_a_scaled_number_is_the_nearest_decimal_number(icd, raw):
    row = icd.telecommands["set"]
    assert row.named_fields["centi"].to_physical(raw) == raw / 100


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
    arrived = HoleMap([0, MAX_PACKETS - 1, MAX_PACKETS, -1])
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
