"""What the device answers to: every row has a handler, errors as published, counters, unsolicited telemetry."""

import pytest

from starhil.emulator.device.actions import ACTIONS
from starhil.emulator.device.counters import Counters
from starhil.emulator.device.quantities import QUANTITIES
from starhil.emulator.profile import Profile
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, ReplyKind, Request
from starhil.protocol.unit import load_unit


def test_the_device_has_what_its_model_declares():
    model = load_unit().model
    assert set(QUANTITIES) == set(model.quantities)
    assert set(ACTIONS) == set(model.actions)


@pytest.mark.parametrize("mode", ["standby", "lost_in_space"])
@pytest.mark.parametrize("name", load_unit().telemetry)
def test_every_telemetry_row_answers_in_every_state(make_bench, name, mode):
    bench = make_bench().start()
    bench.command("set_mode", mode=mode)
    bench.step(3.0)
    values = bench.read(name)
    assert set(values) == set(bench.icd.telemetry[name].named_fields)


@pytest.mark.parametrize(
    ("identifier", "data", "code"),
    [
        (31, b"", ErrorCode.INVALID_ID),
        (0, b"\x01", ErrorCode.INVALID_ID),
        (200, b"", ErrorCode.INVALID_ID),
        (1, b"", ErrorCode.INVALID_LENGTH),
        (1, b"\x5a\x00", ErrorCode.CRC),
        (1, b"\x5a\x00\x00", ErrorCode.INVALID_LENGTH),
        (1, b"\x5b", ErrorCode.INVALID_PARAMETER),
        (96, b"\x04", ErrorCode.INVALID_PARAMETER),
        (2, b"\x00\x00\x00\x00\xe8\x03", ErrorCode.INVALID_PARAMETER),
        (37, bytes(52), ErrorCode.INVALID_LENGTH),
        (128, b"\x00", ErrorCode.INVALID_LENGTH),
    ],
)
def test_bad_requests_get_the_published_code_and_change_nothing(bench, identifier, data, code):
    (reply,) = bench.requests.handle(Request.of(identifier, data))
    assert (reply.kind, reply.id, reply.code) == (ReplyKind.NACK, identifier, code)
    assert bench.mode == "standby"


def test_the_acknowledge_reports_the_result_of_the_last_telecommand(bench):
    bench.command("set_mode", mode="lost_in_space")
    assert bench.read("acknowledge") == {
        "last_telecommand": 96, "processed": True, "error": "ok", "parameter_index": 0,
    }  # fmt: skip
    bench.send("set_unix_time", b"\x00\x00\x00\x00\xff\xff")
    assert bench.read("acknowledge") == {
        "last_telecommand": 2, "processed": True, "error": "invalid_parameter", "parameter_index": 1,
    }  # fmt: skip
    bench.send("set_mode", b"")
    assert bench.read("acknowledge")["error"] == "invalid_length"


def test_counters_count_and_clear(bench):
    for _ in range(3):
        bench.command("set_mode", mode="standby")
    bench.requests.handle(Request.of(31))
    status = bench.read("communication_status")
    assert (status["telecommand_count"], status["telemetry_count"]) == (4, 1)
    assert bench.command("clear_counters") is ErrorCode.OK
    status = bench.read("communication_status")
    assert (status["telecommand_count"], status["telemetry_count"]) == (0, 1)


def test_before_the_first_telecommand_nothing_is_pending(bench):
    assert bench.read("acknowledge") == {
        "last_telecommand": 0, "processed": True, "error": "ok", "parameter_index": 0,
    }  # fmt: skip


def test_each_fault_of_a_link_counts_once(bench):
    for expected in (1, 2):
        bench.requests.count_fault(LinkFault(FaultKind.UART_PROTOCOL, "noise"))
        assert bench.device.counters.faults == {FaultKind.UART_PROTOCOL: expected}
    assert bench.read("communication_status")["uart_protocol_error"]


def test_counters_wrap_at_16_bits(bench):
    bench.device.counters = Counters(telecommands=65535)
    bench.command("set_mode", mode="standby")
    assert bench.read("communication_status")["telecommand_count"] == 0


def test_unsolicited_telemetry_is_sent_at_its_rate(bench):
    sent = []
    bench.device.signals.unsolicited.connect(sent.append)
    assert bench.command("set_unsolicited", telemetry=160, rate=4.0) is ErrorCode.OK
    bench.step(9.99)
    assert len(sent) == 40
    assert {(reply.kind, reply.id, reply.destination) for reply in sent} == {(ReplyKind.UNSOLICITED, 160, 1)}
    assert bench.icd.telemetry["precise_attitude"].decode(sent[0].data)["reason"] == "not_running"
    bench.command("set_unsolicited", telemetry=160, rate=0.0)
    bench.step(5.0)
    assert len(sent) == 40


def test_unsolicited_telemetry_of_the_profile_starts_by_itself(make_bench):
    bench = make_bench(Profile(parameters={"unsolicited_rate": 2.0, "unsolicited_selection": 128}))
    sent = []
    bench.device.signals.unsolicited.connect(sent.append)
    bench.start()
    assert len(sent) == 3
    assert sent[0].id == 128


def test_unsolicited_image_frame_is_left_out_while_an_image_is_opened(bench):
    sent = []
    bench.device.signals.unsolicited.connect(sent.append)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    bench.command("set_unsolicited", telemetry=192, rate=20.0)
    bench.step(0.01)
    assert len(sent) == 1
    bench.command("init_image_download", sram=1, image_size="size_64")  # busy for 100 ms: two periods
    bench.step(0.09)
    assert len(sent) == 1
    bench.step(0.1)
    assert len(sent) == 3
    assert len(sent[-1].data) == 128


def test_a_telecommand_that_fails_unexpectedly_ends_with_an_error_code_and_is_logged(
    bench, monkeypatch, caplog
):
    monkeypatch.setattr(bench.requests.telecommand_bindings["set_mode"], "execute", lambda *_: 1 / 0)
    assert bench.command("set_mode", mode="standby") is ErrorCode.INTERNAL
    assert bench.read("acknowledge") == {
        "last_telecommand": 96, "processed": True, "error": "internal", "parameter_index": 0,
    }  # fmt: skip
    assert "telecommand 96: internal error: ZeroDivisionError" in caplog.text
    bench.command("clear_counters")
    assert not bench.read("communication_status")["telecommand_overrun"]


def test_telemetry_that_fails_unexpectedly_is_answered_with_an_error_code_and_logged(
    bench, monkeypatch, caplog
):
    monkeypatch.setattr(bench.requests.telemetry_bindings["rates"], "encode", lambda _shot: 1 / 0)
    (reply,) = bench.requests.handle(Request.of(bench.icd.telemetry["rates"].id))
    assert (reply.kind, reply.code) == (ReplyKind.NACK, ErrorCode.INTERNAL)
    assert "telemetry rates: internal error: ZeroDivisionError" in caplog.text


def test_unsolicited_telemetry_needs_a_row(bench):
    assert bench.command("set_unsolicited", telemetry=200, rate=1.0) is ErrorCode.INVALID_PARAMETER
