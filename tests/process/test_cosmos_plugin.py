"""OpenC3 COSMOS drives the running emulator through the exported plugin: every command, every telemetry."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Self

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.protocol.icd.quoting import cosmos_state
from starhil.protocol.unit import load_unit
from tests.protocol.export.cosmos_plugin import Plugin
from tests.protocol.export.test_export import same
from tests.protocol.serial.composed_links import CUBESTAR
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process


ICD = load_unit()
CHANGES_THE_DIALECT = frozenset({"reset", "restore_parameters", "default_parameters"})
DEFAULT = str(ICD.parameters["serial_dialect"].default)
DIALECTS = tuple(ICD.enums["serial_dialect"].values)


class Cosmos:
    """A COSMOS interface with the plugin's protocol, and its target's packets; a context manager."""

    def __init__(self, plugin: Plugin) -> None:
        from openc3.packets.commands import Commands
        from openc3.packets.packet_config import PacketConfig
        from openc3.packets.telemetry import Telemetry
        from openc3.top_level import get_class_from_module
        from openc3.utilities.string import filename_to_class_name, filename_to_module

        config = PacketConfig()
        for name in ("cmd", "tlm"):
            config.process_file(str(plugin.text(f"cmd_tlm/{name}.txt")), plugin.target)
        assert config.warnings == []
        self._target = plugin.target
        self._commands, self._telemetry = Commands(config, None), Telemetry(config, None)
        _, file, *arguments = plugin.arguments("INTERFACE")
        interface = get_class_from_module(filename_to_module(file), filename_to_class_name(file))
        self._interface = interface(*arguments)
        direction, protocol, *parameters = plugin.arguments("PROTOCOL")
        self._interface.add_protocol(plugin.protocol_class(protocol), parameters, direction)
        self._packets: SimpleQueue[Any] = SimpleQueue()

    def __enter__(self) -> Self:
        self._interface.connect()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._interface.disconnect()
        self._reader.join(10.0)

    def _read(self) -> None:
        while (packet := self._interface.read()) is not None:
            self._packets.put(packet)

    def send(self, name: str, **values: object) -> None:
        """Send a command."""
        self._interface.write(self._commands.build_cmd(self._target, name, values))

    def receive(self) -> tuple[str, Any]:
        """Return the next packet and its name."""
        try:
            raw = self._packets.get(timeout=PATIENCE_S)
        except Empty:
            raise AssertionError("COSMOS received no packet in time") from None
        packet = self._telemetry.identify(raw.buffer, [self._target])
        assert packet is not None, raw.buffer
        packet.buffer = raw.buffer
        return packet.packet_name, packet


@pytest.fixture(params=DIALECTS)
def dialect(request: pytest.FixtureRequest, can_obc: ObcClient) -> Iterator[str]:
    """A dialect that the emulator replies in, until it is commanded another."""
    pytest.importorskip(
        "openc3.packets.packet_config", reason="openc3 drives the emulator; it is not installed (make cosmos)"
    )
    can_obc.wait_for("device_status", lambda reading: reading["mode"] != "boot", within_s=PATIENCE_S)
    can_obc.command("set_mode", mode="standby")
    can_obc.set_parameter("serial_dialect", request.param)
    yield request.param
    can_obc.command("default_parameters")
    can_obc.command("save_parameters")


@pytest.fixture
def connect(emulator, tmp_path: Path) -> Callable[[str], Cosmos]:
    """A function that installs the plugin for a dialect and makes its interface."""
    return lambda dialect: Cosmos(
        Plugin(ICD, tmp_path / dialect, port=emulator.ready["serial"], dialect=dialect)
    )


@pytest.fixture
def cosmos(dialect: str, connect: Callable[[str], Cosmos]) -> Iterator[Cosmos]:
    with connect(dialect) as running:
        yield running


def test_every_telemetry_row_is_requested_and_read(cosmos: Cosmos, can_obc: ObcClient) -> None:
    for row in ICD.telemetry.values():
        cosmos.send(f"REQUEST_{row.name.upper()}")
        name, packet = cosmos.receive()
        assert name == row.name.upper()
        decoded = row.decode(bytes(packet.buffer)[1:])
        for field, value in decoded.items():
            read = packet.read(field.upper(), "CONVERTED")
            expected = str(value).upper() if isinstance(value, (bool, str)) else value
            assert same(bytes(read) if isinstance(value, bytes) else read, expected), f"{row.name}.{field}"
        if row.name in ("boot_status", "star_config", "hole_map_1"):
            assert decoded == can_obc.telemetry(row.name)


def test_every_command_is_sent_and_answered(cosmos: Cosmos, can_obc: ObcClient) -> None:
    for row in ICD.telecommands.values():
        if row.name in CHANGES_THE_DIALECT:
            continue
        values = {
            name.upper(): str(value).upper() if isinstance(value, (bool, str)) else value
            for name, value in row.example().items()
        }
        cosmos.send(row.name.upper(), **values)
        if not CUBESTAR.answers(row):
            continue  # the next command does not wait for a reply
        name, packet = cosmos.receive()
        while name == "FILE_BURST":
            name, packet = cosmos.receive()
        assert (name, packet.read("COMMAND")) == ("ANSWER", row.name.upper())
        seen = can_obc.telemetry("acknowledge")
        assert (seen["last_telecommand"], str(seen["error"]).upper()) == (row.id, packet.read("CODE"))


@pytest.mark.parametrize("name", sorted(CHANGES_THE_DIALECT))
def test_after_a_command_that_changes_the_dialect_cosmos_reconnects_with_the_new_one(
    name: str, dialect: str, connect: Callable[[str], Cosmos], can_obc: ObcClient
) -> None:
    stored = next(other for other in DIALECTS if other not in (dialect, DEFAULT))
    can_obc.set_parameter("serial_dialect", stored)
    can_obc.command("save_parameters")
    can_obc.set_parameter("serial_dialect", dialect)
    up_s = can_obc.telemetry("device_status")["uptime"]
    with connect(dialect) as before:
        before.send(name.upper())
        if CUBESTAR.answers(ICD.telecommands[name]):
            answer, packet = before.receive()
            assert (answer, packet.read("COMMAND"), packet.read("CODE")) == ("ANSWER", name.upper(), "OK")
        else:  # the device restarts
            can_obc.wait_for("device_status", lambda reading: reading["uptime"] < up_s, within_s=PATIENCE_S)
    with connect(DEFAULT if name == "default_parameters" else stored) as after:
        after.send("REQUEST_IDENTIFICATION")
        answer, packet = after.receive()
        assert (answer, packet.read("NODE_TYPE")) == (
            "IDENTIFICATION",
            can_obc.telemetry("identification")["node_type"],
        )


def test_a_refusal_comes_with_its_code(cosmos: Cosmos) -> None:
    cosmos.send("SELECT_PARAMETER", PARAMETER=0)
    name, packet = cosmos.receive()
    assert (name, packet.read("COMMAND"), packet.read("CODE")) == (
        "ANSWER",
        "SELECT_PARAMETER",
        "INVALID_PARAMETER",
    )


def test_requests_in_a_row_keep_their_names(cosmos: Cosmos) -> None:
    names = ["QUATERNION", "RATES", "QUATERNION", "ACKNOWLEDGE", "STAR_1_RAW", "STAR_2_RAW"] * 5
    for name in names:
        cosmos.send(f"REQUEST_{name}")
    assert [cosmos.receive()[0] for _ in names] == names


def test_a_unit_with_another_link_is_driven_through_its_plugin(sagitta, tmp_path: Path) -> None:
    pytest.importorskip(
        "openc3.packets.packet_config", reason="openc3 drives the emulator; it is not installed (make cosmos)"
    )
    icd = load_unit("sagitta")
    with Cosmos(Plugin(icd, tmp_path, port=sagitta.ready["serial"])) as cosmos:
        for row in icd.telecommands.values():
            if row.action == "subscribe":
                continue
            cosmos.send(row.name.upper(), **{name.upper(): value for name, value in row.example().items()})
            name, packet = cosmos.receive()
            assert (name, packet.read("COMMAND"), packet.read("CODE")) == ("ANSWER", row.name.upper(), 0)
        for row in icd.telemetry.values():
            cosmos.send(f"REQUEST_{row.name.upper()}")
            name, packet = cosmos.receive()
            assert name == row.name.upper()
            for field, value in row.decode(bytes(packet.buffer)[2:]).items():
                read = packet.read(field.upper(), "CONVERTED")
                expected = cosmos_state(str(value)) if row.named_fields[field].enum is not None else value
                assert same(read, expected), f"{row.name}.{field}"
