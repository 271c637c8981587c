"""Rows that are only sent: `unit check` and the emulator accept and reject the same definitions, in one line an error."""

from __future__ import annotations

from pathlib import Path

import cantools
import pytest

from starhil.emulator.profile import Profile
from starhil.emulator.run.run import _unit_of
from starhil.protocol.errors import OneLineError
from starhil.protocol.export import export, export_folder
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine
from tests.emulator.conftest import Bench
from tests.user_units import ATTITUDE, HEAD, STREAM, packets, written

SUBSCRIBING = (
    STREAM.partition("[[telecommand]]")[1]
    + STREAM.partition("[[telecommand]]")[2].partition("[[telecommand]]")[0]
)


def errors(folder: Path, text: str) -> list[str]:
    """Return the errors of `unit check`, which must be those of a start, without the name of the file."""
    unit = written(folder, text)
    problems = examine(unit)[1]
    started: list[str] = []
    try:
        _unit_of(Profile.model_validate({"unit": str(unit), "links": {"can": {"channel": "off"}}}))
    except OneLineError as error:
        started = list(error.problems)
    assert started == problems
    return [line.removeprefix(f"{unit}/unit.toml: ") for line in problems]


@pytest.mark.parametrize("text", [packets("u8"), packets("u16"), STREAM], ids=["u8", "u16", "stream"])
def test_a_definition_that_passes_starts(tmp_path: Path, text: str) -> None:
    assert errors(tmp_path / "unit", text) == []


@pytest.mark.parametrize("length", ["u8", "u16"])
def test_space_packets_pass_as_they_run(tmp_path: Path, length: str) -> None:
    unit = written(tmp_path / "unit", packets(length))
    definition, found, examples = examine(unit)
    assert found == []
    sent = {item.row.name: item for item in examples}
    assert sent["attitude"].request == ()
    (packet,) = sent["attitude"].answers
    size = bytes.fromhex(packet)[8:-2][: {"u8": 1, "u16": 2}[length]]
    assert int.from_bytes(size) == definition.telemetry["attitude"].size - 1  # CCSDS 133.0-B, 4.1.3.5.3
    assert packet.startswith("1A CF FC 1D 01 02 C0 00")
    assert sent["set_time"].answers == sent["verification"].answers


def test_a_row_that_may_be_requested_but_cannot_is_named_with_field_and_remedy(tmp_path: Path) -> None:
    text = packets().replace("request = false\n", "")
    (found,) = errors(tmp_path / "unit", text)
    assert found == (
        "telemetry verification: link.serial: request: link.serial.request_header: length -1 does not fit 16 bits; "
        "correct that field, or set `request = false` if the row is only sent (and 1 more row)"
    )


def test_an_acknowledge_without_data_is_named_with_its_remedy(tmp_path: Path) -> None:
    (problem,) = errors(tmp_path / "unit", packets().replace('answer = ["row', 'answer = ["reply", "row'))
    assert problem.startswith(
        "telecommand set_time: link.serial: answer: link.serial.reply_header: length -1 does not fit"
    )
    assert problem.endswith("correct that field, or set `answer = []` if it is not answered")


def test_all_rows_that_do_not_fit_are_listed_at_once(tmp_path: Path) -> None:
    long = '[[telemetry]]\nid = {0}\nname = "long_{0}"\ndoc = "d"\nfields = [{{ name = "a", type = "bytes", size = {1}, default = "" }}]\n'
    head, _, link = STREAM.partition("[link.serial]")
    rows = "".join(long.format(number, size) for number, size in ((20, 256), (21, 255), (22, 300)))
    problems = errors(
        tmp_path / "unit",
        head + rows.replace(', default = ""', ', value = "image.chunk"') + "[link.serial]" + link,
    )
    assert [line.partition(":")[0] for line in problems] == ["telemetry long_20", "telemetry long_22"]
    assert all(
        f"length {size} does not fit 8 bits" in line for line, size in zip(problems, (256, 300), strict=True)
    )


def test_a_row_that_nothing_sends_is_an_error(tmp_path: Path) -> None:
    link = STREAM[STREAM.index("[link.serial]") :]
    never = ATTITUDE.replace("ID", "3").replace("KEYS", "request = false")
    (found,) = errors(tmp_path / "unit", HEAD + never + link)
    assert found.startswith(
        "telemetry attitude: `request = false`, but nothing sends it; add `unsolicited`, or 'row:attitude'"
    )
    assert errors(tmp_path / "selected", HEAD + SUBSCRIBING + never + link) == []
    parameter = '[[parameter]]\nid = 2\nname = "unsolicited_selection"\n'
    assert errors(tmp_path / "by_parameter", HEAD + parameter + never + link) == []


def test_a_telecommand_is_always_requested(tmp_path: Path) -> None:
    (found,) = errors(
        tmp_path / "unit", STREAM.replace('action = "nothing"\n', 'action = "nothing"\nrequest = false\n')
    )
    assert found == "telecommand ping: only telemetry is sent without a request; remove `request = false`"


FORMATS = """
[[class]]
name = "command"
kind = "telecommand"
KEYS

[[class]]
name = "telemetry"
kind = "telemetry"

[[telecommand]]
id = 1
name = "ping"
doc = "d"
action = "nothing"

[link.serial]
framing = { kind = "length", start = [0x90] }
request_header = [{ role = "length", type = "u8" }, { role = "id", type = "u8" }]
reply_header = [{ role = "length", type = "u8" }, { role = "id", type = "u8" }]

[[link.serial.format]]
classes = ["command"]
framing = { kind = "fixed", start = [0x90], request_size = SIZE }
"""
LEAST_MESSAGES = ATTITUDE.replace("ID", "3").replace("KEYS", "request = false\nunsolicited = 2.0")


def formats(keys: str, size: int = 2) -> str:
    return HEAD + LEAST_MESSAGES + FORMATS.replace("KEYS", keys).replace("SIZE", str(size))


def test_a_class_without_messages_in_a_direction_needs_no_start_of_its_own(tmp_path: Path) -> None:
    assert errors(tmp_path / "silent", formats("answer = []")) == []
    (found,) = errors(tmp_path / "answered", formats(""))
    assert found.startswith(
        "link.serial.format: reply: framings fixed of class command and length of all other messages start with 90; "
    )


def test_a_size_that_no_request_has_is_named_with_its_row(tmp_path: Path) -> None:
    (found,) = errors(tmp_path / "unit", formats("answer = []", 5))
    assert found == (
        "telecommand ping: link.serial: request: 2 bytes between start and end, but link.serial.framing.request_size "
        "is 5; correct it, or the fields of the row"
    )


def test_a_request_that_the_receiver_drops_says_why(tmp_path: Path) -> None:
    found = errors(tmp_path / "unit", STREAM.replace("[link.serial]", "[link.serial]\nmax_size = 2"))
    assert found[0].endswith(
        "framing length does not return the request that it encoded; it returns: message longer than 2 bytes (and 3 more rows)"
    )


ON_CAN = (
    HEAD
    + ATTITUDE.replace("ID", "130").replace("KEYS", "request = false\nunsolicited = 2.0")
    + '[link.can]\nkind = "cubespace"\n'
)


def test_exports_have_the_row_but_no_request_for_it(tmp_path: Path) -> None:
    on_can = load_unit(written(tmp_path / "can", ON_CAN))
    dbc = cantools.database.load_string(export(on_can, "dbc"), "dbc")
    (message,) = dbc.messages
    assert (message.name, message.frame_id) == (
        "TLM_attitude",
        0x0A820401,
    )  # 10: first segment of unsolicited telemetry
    assert "without a request: `0A820401#" in export(on_can, "markdown")
    assert ", only sent" in export(on_can, "html")
    on_serial = load_unit(
        written(
            tmp_path / "serial", STREAM.replace('name = "attitude"\n', 'name = "attitude"\nrequest = false\n')
        )
    )
    commands = export_folder(on_serial, "cosmos-plugin")
    (text,) = (text for name, text in commands.items() if name.endswith("cmd.txt"))
    assert "REQUEST_STATUS" in text
    assert "REQUEST_ATTITUDE" not in text


def test_the_device_refuses_a_request_for_the_row_and_sends_it(tmp_path: Path) -> None:
    bench = Bench(unit=str(written(tmp_path / "unit", packets()))).start()
    sent: list[Reply] = []
    bench.device.signals.unsolicited.connect(sent.append)
    row = bench.icd.telemetry["attitude"]
    (reply,) = bench.requests.handle(bench.icd.request(row))
    assert (reply.kind, reply.code) == (ReplyKind.NACK, ErrorCode.INVALID_ID)
    bench.step(3.0)
    assert {(item.kind, item.id) for item in sent} == {(ReplyKind.UNSOLICITED, row.id)}
