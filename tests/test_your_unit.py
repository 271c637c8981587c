"""The tutorial of a unit: its files have no errors, its exchange is the one shown, its client reads the truth."""

from __future__ import annotations

import asyncio
import re

import pytest
import serial
from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.emulator.launch import Emulator, RunOptions
from starhil.emulator.profile import Profile
from starhil.protocol.messages import FaultKind
from starhil.protocol.serial.framings import Receiving
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.emulator.conftest import FakePipeline
from tests.emulator.runs import FakeImager
from tests.test_docs import blocks, programs, run
from tests.waiting import PATIENCE_S

PAGE = "your-unit.md"
STREAMING = "A unit that streams by itself"
PYTHON = "A framing in Python"


def written(folder, streams_by_itself=False):
    """Write the unit of the page into a folder, or that which measures from power-on and streams a selected row."""
    folder.mkdir()
    tables = [block for block in blocks(PAGE) if block.language == "toml"]
    text = "\n".join(block.text for block in tables if streams_by_itself or block.heading != STREAMING)
    (folder / "unit.toml").write_text(text, encoding="utf-8")
    return folder


def test_the_unit_of_the_page_has_no_errors_and_the_exchange_that_is_shown(tmp_path):
    result = CliRunner().invoke(build_app(["unit"]), ["unit", "check", str(written(tmp_path / "lynx"))])
    assert result.exit_code == 0, result.output
    shown = next(block for block in blocks(PAGE) if block.heading == "Check it" and block.language == "text")
    example, end = shown.text.split("…\n")
    assert example in result.stdout
    assert result.stdout.endswith(end.replace("lynx", str(tmp_path / "lynx")))


def test_the_client_of_the_page_prints_the_output_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "starhil.emulator.run.run.make_pipeline", lambda *_, **__: FakeImager(FakePipeline().handle)
    )
    profile = Profile.model_validate(
        {
            "unit": str(written(tmp_path / "lynx")),
            "links": {"can": {"channel": "off"}},
            "truth": {"kind": "fixed", "attitude": {"ra_deg": 83.8, "dec_deg": -1.2, "roll_deg": 0.0}},
            "health": {"temperature": 21.5},
        }
    )
    ((client, printed),) = programs(PAGE)

    async def read() -> str:
        emulator = Emulator([profile], RunOptions())
        try:
            await emulator.start()
            await emulator.ready()
            port = emulator.run.heads[0].ready_fields["serial"]
            return await asyncio.to_thread(run, client, {"PORT": port})
        finally:
            await emulator.close()

    assert asyncio.run(read()) == printed


def test_the_framing_of_the_page_carries_every_message(tmp_path):
    folder = written(tmp_path / "lynx")
    file = folder / "unit.toml"
    text = file.read_text(encoding="utf-8").replace(
        'framing = { kind = "length", start = [0x1A, 0xCF, 0xFC, 0x1D] }',
        'framing = { kind = "custom", name = "cobs" }',
    )
    file.write_text(text.replace("[unit]", '[unit]\nplugin = "unit.py"'), encoding="utf-8")
    (source,) = [block.text for block in blocks(PAGE, "python") if block.heading == PYTHON]
    (folder / "unit.py").write_text(source, encoding="utf-8")
    result = CliRunner().invoke(build_app(["unit"]), ["unit", "check", str(folder)])
    assert result.exit_code == 0, result.output
    assert (
        "  > 01 03 0B C0 0B 01 10 01 02 03 04" in result.stdout
    )  # length 12 - 1, sequence 0, group 1, ID 16
    stack = SerialStack(load_unit(folder))
    request = load_unit(folder).request_of(0x10, "command", bytes(6))
    line = stack.encode_request(request)
    device = stack.device()
    assert line.count(0) == 1
    assert device.feed(b"\x05ab\0" + line[:5], 0.0)[0].kind is FaultKind.UART_PROTOCOL
    assert [event.data for event in device.feed(line[5:], 0.1)] == [bytes(6)]
    device.feed(line[:5], 1.0)
    assert [fault.kind for fault in device.flush(9.0)] == [FaultKind.UART_INCOMPLETE]
    body = bytes(range(256)) * 4
    framing = load_unit(folder).plugin.framings["cobs"]()
    received = framing.deframer(Receiving(lambda data: data, lambda _: None, 2000, 1.0))
    for size in (*range(3), *range(250, 260), 508, 509, 1024):
        assert received.feed(framing.encode(body[:size]), 0.0) == [body[:size]], size
        assert received.feed(framing.encode(b"a" * size), 0.0) == [b"a" * size], size


@pytest.mark.long
def test_the_unit_of_the_page_streams_by_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "starhil.emulator.run.run.make_pipeline", lambda *_, **__: FakeImager(FakePipeline().handle)
    )
    folder = written(tmp_path / "lynx")
    (more,) = [block.text for block in blocks(PAGE, "toml") if block.heading == STREAMING]
    (folder / "more.toml").write_text(more, encoding="utf-8")
    profile = Profile.model_validate({"unit": str(folder), "links": {"can": {"channel": "off"}}})

    def listen(port: str) -> bytes:
        with serial.Serial(port, timeout=PATIENCE_S) as line:
            return line.read(400)

    async def read() -> bytes:
        emulator = Emulator([profile], RunOptions())
        try:
            await emulator.start()
            await emulator.ready()
            return await asyncio.to_thread(listen, emulator.run.heads[0].ready_fields["serial"])
        finally:
            await emulator.close()

    stream = asyncio.run(read())
    heads = re.findall(rb"\x1a\xcf\xfc\x1d..(..)(\xc2[\x40\x41]|\xc3\x50)\x00", stream, re.DOTALL)
    assert {kind.hex() for _number, kind in heads} == {"c241", "c240", "c350"}
    numbers = [int.from_bytes(number) for number, _kind in heads]
    assert numbers == list(range(numbers[0], numbers[0] + len(heads)))
    assert numbers[0] >= 0xC000
