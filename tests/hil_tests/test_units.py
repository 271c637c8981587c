"""The OBC client on another unit: answers of other rows, errors by the unit's numbers, telecommands without an answer."""

import asyncio
import struct

import pytest

from starhil.hil_tests.client import AsyncObcClient, ObcClient
from starhil.hil_tests.conformance.conformance_run import ConformanceRequest, run_conformance
from starhil.hil_tests.errors import BenchError, NackError, ScriptError
from starhil.hil_tests.session.script import load_script
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import Reply, ReplyKind
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.user_units import STREAM, packets, written
from tests.waiting import PATIENCE_S

DEFINITION = """
[unit]
name = "x"
version = "1"
doc = "d"
[errors]
busy = 66
[[class]]
name = "do"
kind = "telecommand"
code = 1
[[class]]
name = "get"
kind = "telemetry"
code = 2
"""


def row(kind: str, number: int, name: str, fields: str = "", more: str = "") -> str:
    """Text of a row."""
    return f'[[{kind}]]\nid = {number}\nname = "{name}"\ndoc = "d"\nprovenance = "ours"\n{more}\nfields = [{fields}]\n'


@pytest.mark.parametrize(
    ("unit", "message"), [("sagitta", "has no reply dialects"), ("cubestar-gen2", "has only dialect c")]
)
def test_a_dialect_that_the_unit_does_not_have_is_refused(unit, message):
    request = ConformanceRequest(unit=unit, serial="/dev/null", dialect="b")
    with pytest.raises(BenchError, match=f"--dialect b: unit {unit} {message}"):
        run_conformance(request)
    with pytest.raises(ProtocolError, match=message):
        ObcClient.open(serial="/dev/null", unit=unit, dialect="b")


class FakeLink:
    """Answers each request with the replies that the test has set."""

    def __init__(self, *replies: Reply) -> None:
        self.replies = replies
        self.requests = []
        self.on_reply = self.on_fault = None

    def answers(self, row):
        return row.answers

    def dialect_of_reply(self, _request):
        """This link has no dialects."""

    def request(self, request):
        self.requests.append(request)
        for reply in self.replies:
            self.on_reply(reply)


@pytest.fixture
def ask(tmp_path):
    """Ask a client something, with a link that answers as given."""
    text = (
        DEFINITION
        + row("telemetry", 1, "status", '{ name = "count", type = "u16" }')
        + row("telemetry", 2, "other", '{ name = "count", type = "u16" }')
        + row("telecommand", 1, "go", more='answer = ["row:status"]')
        + row("telecommand", 3, "silent", more="answer = []")
    )
    (tmp_path / "unit.toml").write_text(text, encoding="utf-8")
    icd = load_unit(tmp_path)

    def ask(call, *replies):
        async def whole():
            client = AsyncObcClient(FakeLink(*replies), icd, timeout_s=PATIENCE_S)
            return client, await call(client)

        return asyncio.run(whole())

    return ask


STATUS = Reply(ReplyKind.TELEMETRY, 1, struct.pack("<H", 7), message_class="get")


def test_a_row_is_distinguished_from_one_of_another_class_with_the_same_id(ask):
    client, values = ask(
        lambda obc: obc.telemetry("status"), Reply(ReplyKind.ACK, 1, message_class="do"), STATUS
    )
    assert values == {"count": 7}
    assert [reply.message_class for reply in client.stray_replies] == ["do"]


def test_a_telecommand_is_answered_by_the_row_that_the_unit_names(ask):
    other = Reply(ReplyKind.TELEMETRY, 2, b"\0\0", message_class="get")
    client, ack = ask(lambda obc: obc.command("go"), other, STATUS)
    assert ack.name == "go"
    assert list(client.stray_replies) == [other]


def test_a_telecommand_without_an_answer_is_not_waited_for(ask):
    client, ack = ask(lambda obc: obc.command("silent"))
    assert ack.name == "silent"
    assert [request.id for request in client.link.requests] == [3]


def test_a_refusal_has_the_name_that_the_unit_gives_its_number(ask):
    with pytest.raises(NackError, match=r"error 66 \(busy\)"):
        ask(lambda obc: obc.command("go"), Reply(ReplyKind.NACK, 1, code=66, message_class="do"))


def test_a_streamed_row_that_looks_like_an_answer_is_unsolicited(tmp_path):
    stream = load_unit(written(tmp_path / "unit", STREAM))
    status, attitude = stream.telemetry["status"], stream.telemetry["attitude"]
    link = FakeLink(
        Reply(ReplyKind.TELEMETRY, attitude.id, attitude.encode({"w": 0.5})),
        Reply(ReplyKind.TELEMETRY, status.id, bytes(status.size)),
    )
    link.marks_unsolicited = SerialStack(stream).marks_unsolicited

    async def scenario():
        client = AsyncObcClient(link, stream)
        read = await client.read("status")
        return read, await client.wait_unsolicited("attitude", timeout_s=1.0), client.stray_replies

    read, streamed, stray = asyncio.run(scenario())
    assert (read.name, streamed["w"], list(stray)) == ("status", 0.5, [])


def test_a_row_that_is_only_sent_cannot_be_read(tmp_path):
    unit = load_unit(written(tmp_path / "unit", packets()))
    link = FakeLink()
    with pytest.raises(BenchError, match="attitude: is only sent, and no request reads it"):
        asyncio.run(AsyncObcClient(link, unit).read("attitude"))
    assert link.requests == []
    script = tmp_path / "session.toml"
    script.write_text('[[step]]\nread = "attitude"\n', encoding="utf-8")
    with pytest.raises(ScriptError, match="'attitude' is only sent, and no request reads it: use listen"):
        load_script(script, unit)
    script.write_text('[[step]]\nlisten = "attitude"\n', encoding="utf-8")
    assert len(load_script(script, unit).steps) == 1
