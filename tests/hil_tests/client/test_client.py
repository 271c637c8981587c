"""The OBC client over a pty (three dialects) and over the TCP hub, with a canned device."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time

import pytest

from starhil.hil_tests.client import AsyncObcClient, ObcClient
from starhil.hil_tests.client.canopen_link import CanopenHostLink
from starhil.hil_tests.client.images import list_files
from starhil.hil_tests.client.raw_traffic import parse_frame, send_and_listen
from starhil.hil_tests.errors import BadReplyError, BenchError, LinkLostError, NackError, NoReplyError
from starhil.protocol.can.cubespace import CanHostReceiver, encode_reply_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import FieldError, UnknownNameError
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.transports.can import open_can
from starhil.protocol.unit import load_unit
from tests.hil_tests.fake_device import EDGE, FakeDevice, bmp_file
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.long

TIMEOUT_S = 0.15
LINKS = ["serial-a", "serial-b", "serial-c", "can"]


@pytest.fixture(params=LINKS)
def pair(request, hub):
    """A device and a client on it."""
    with FakeDevice() as device:
        if request.param == "can":
            options = {"can": device.open_can(hub)}
        else:
            device.dialect = Dialect(request.param[-1])
            options = {"serial": device.open_serial(), "dialect": request.param[-1]}
        with ObcClient.open(**options, timeout_s=PATIENCE_S) as client:
            yield device, client


def test_telemetry_comes_in_physical_units(pair):
    device, client = pair
    device.telemetry["rates"] = {"rate_x": 0.3, "rate_y": -0.0001, "rate_z": 0.0}
    device.telemetry["precise_attitude"] = {"valid": True, "mode": "tracking", "q_w": 1.0}
    assert client.telemetry("rates") == pytest.approx({"rate_x": 0.3, "rate_y": -0.0001, "rate_z": 0.0})
    reading = client.read("precise_attitude")
    assert (reading["valid"], reading["mode"], reading["q_w"]) == (True, "tracking", 1.0)
    assert 0.0 < reading.latency_s < PATIENCE_S


def test_readings_of_the_same_values_are_equal_whenever_they_came(pair):
    device, client = pair
    device.telemetry["rates"] = {"rate_x": 0.3}
    first, second = client.read("rates"), client.read("rates")
    assert (first == second, first.received_s == second.received_s) == (True, False)
    device.telemetry["rates"] = {"rate_x": 0.4}
    assert client.read("rates") != first


def test_an_unknown_field_of_a_reading_is_named_with_similar_ones(pair):
    device, client = pair
    device.telemetry["rates"] = {"rate_x": 0.3}
    reading = client.read("rates")
    for look_up in (reading.__getitem__, reading.values.__getitem__):
        with pytest.raises(UnknownNameError, match=r"^no field of rates named 'rat_x'; did you mean rate_x"):
            look_up("rat_x")
        with pytest.raises(KeyError, match=r"named 'foo'; known: rate_x, rate_y, rate_z$"):
            look_up("foo")


def test_a_telecommand_reaches_the_device_unchanged(pair):
    device, client = pair
    acknowledge = client.command("set_unix_time", seconds=0x1F1F1F1F, milliseconds=31)
    assert acknowledge.name == "set_unix_time"
    assert device.received == [("set_unix_time", {"seconds": 0x1F1F1F1F, "milliseconds": 31})]
    values = client.icd.telecommands["set_star_config"].example()
    client.command("set_star_config", values)
    assert device.received[1][0] == "set_star_config"
    assert device.received[1][1] == pytest.approx(values)


@pytest.mark.parametrize("code", [ErrorCode.INVALID_PARAMETER, ErrorCode.BUSY, ErrorCode.SEQUENCE])
def test_a_refusal_is_an_error_with_the_published_code(pair, code):
    device, client = pair
    device.refuse["save_image"] = code
    device.refuse["rates"] = code
    with pytest.raises(NackError) as caught:
        client.command("save_image", image_size="size_64")
    assert (caught.value.code, caught.value.code_name) == (code, code.name.lower())
    with pytest.raises(NackError) as caught:
        client.read("rates")
    assert caught.value.code == code
    assert client.transactions[-1].outcome == code.name.lower()


@pytest.mark.parametrize("request_of", ["read", "command"])
@pytest.mark.parametrize(("spoken", "expected"), list(itertools.permutations("abc", 2)))
def test_a_reply_in_another_dialect_is_named_with_that_dialect(spoken, expected, request_of):
    with FakeDevice(Dialect(spoken)) as device:
        device.telemetry["rates"] = {"rate_x": 0.3}
        port = device.open_serial()
        with ObcClient.open(serial=port, dialect=expected, timeout_s=TIMEOUT_S) as client:
            for _ in range(2):
                with pytest.raises(
                    BadReplyError, match=rf"replies in dialect {spoken}; choose it with --dialect,"
                ):
                    client.read("rates") if request_of == "read" else client.command("clear_counters")
            assert [each.outcome for each in client.transactions] == ["no_reply", "no_reply"]


@pytest.mark.parametrize("dialect", Dialect)
def test_a_damaged_reply_of_the_own_dialect_is_not_taken_for_one_of_another(dialect):
    """In dialect b, what follows the ID of a late reply in dialect a could be the row that is awaited."""
    with (
        FakeDevice(dialect) as device,
        ObcClient.open(serial=device.open_serial(), dialect=dialect, timeout_s=TIMEOUT_S) as client,
    ):
        client.read("rates")
        for other in set(Dialect) - {dialect}:
            device.dialect = other
            with pytest.raises((NoReplyError, BadReplyError)) as caught:
                client.read("rates")
            assert "dialect" not in str(caught.value)


def test_names_that_are_not_in_the_definition_are_rejected_before_anything_is_sent(pair):
    device, client = pair
    with pytest.raises(ProtocolError, match="set_mode"):
        client.command("set_mod", mode="standby")
    with pytest.raises(ProtocolError, match="quaternion"):
        client.read("quaternoin")
    with pytest.raises(ProtocolError, match="set_mode"):
        client.command("set_mode", mode="dancing")
    assert device.received == []
    assert not client.transactions


def test_out_of_range_values_can_be_sent_unchecked_if_asked(pair):
    _device, client = pair
    wrong = client.icd.telecommands["set_star_config"].example() | {"max_stars_matched": 0}
    for send in (
        lambda **options: client.command("set_star_config", wrong, **options),
        lambda **options: client.set_parameter("exposure", 70000, **options),
        lambda **options: client.set_parameter("exposure", 0.5, **options),
    ):
        client.transactions.clear()
        with pytest.raises(FieldError):
            send()
        assert not client.transactions
        with contextlib.suppress(NackError):  # what the device thinks of it is its own affair
            send(checked=False)
        assert len(client.transactions) == 1


def test_no_reply_is_an_error_after_the_timeout_and_is_retried_only_if_asked(pair):
    device, client = pair
    device.mute = 1
    with pytest.raises(NoReplyError, match=r"rates: no reply within 0\.15 s"):
        client.read("rates", timeout_s=TIMEOUT_S)
    device.mute = 2
    assert client.read("rates", retries=2, timeout_s=1.0)["rate_x"] == 0.0
    device.mute = 2
    with pytest.raises(NoReplyError, match="2 attempts"):
        client.read("rates", retries=1, timeout_s=TIMEOUT_S)
    client.read("rates")
    assert [item.outcome for item in client.transactions] == ["no_reply"] * 3 + ["ok"] + ["no_reply"] * 2 + [
        "ok"
    ]


class CanThatLosesAFrame:
    """A link to a device on CAN that loses the nth frame of its first reply."""

    def __init__(self, lost: int) -> None:
        self.lost, self.receiver = lost, CanHostReceiver(1, 4)
        self.on_reply = self.on_fault = lambda _event: None

    def request(self, request: Request) -> None:
        data = load_unit().telemetry["precise_attitude"].encode({"q_w": 1.0})
        frames = encode_reply_frames(Reply(ReplyKind.TELEMETRY, request.id, data, destination=1), 4)
        lost, self.lost = self.lost, -1
        for number, frame in enumerate(frames):
            for event in self.receiver.feed(frame, 0.0) if number != lost else ():
                (self.on_fault if isinstance(event, LinkFault) else self.on_reply)(event)

    def reset_receiver(self) -> None:
        self.receiver = CanHostReceiver(1, 4)

    def check(self) -> None:
        """Nothing is wrong."""

    def dialect_of_reply(self, _request: Request) -> None:
        """On CAN there are no dialects."""


@pytest.mark.parametrize("lost", [0, 1, -2], ids=["first", "second", "none"])
def test_a_row_of_which_a_can_frame_was_lost_is_requested_again(lost):
    client = AsyncObcClient(CanThatLosesAFrame(lost), load_unit(), timeout_s=TIMEOUT_S, retries=1)
    assert asyncio.run(client.read("precise_attitude"))["q_w"] == 1.0
    assert [item.outcome for item in client.transactions] == ["no_reply"] * (lost >= 0) + ["ok"]


def test_without_retries_a_row_of_another_length_is_reported():
    client = AsyncObcClient(CanThatLosesAFrame(0), load_unit(), timeout_s=TIMEOUT_S)
    with pytest.raises(BadReplyError, match="precise_attitude"):
        asyncio.run(client.read("precise_attitude"))


def test_a_late_reply_does_not_answer_the_next_request(pair):
    device, client = pair
    device.telemetry["rates"] = {"rate_x": 1.0}
    device.telemetry["quaternion"] = {"q_x": 0.5}
    device.mute, device.late_s = 1, TIMEOUT_S + 0.02
    with pytest.raises(NoReplyError):
        client.read("rates", timeout_s=TIMEOUT_S)
    wait_until(lambda: client.stray_replies or client.faults)
    assert client.telemetry("quaternion")["q_x"] == 0.5


def test_a_request_by_number_may_be_undefined(pair):
    _device, client = pair
    for identifier in (200, 60):
        with pytest.raises(NackError) as caught:
            client.request(identifier, b"\x01\x02")
        assert caught.value.code == ErrorCode.INVALID_ID


def test_parameters_are_accessed_by_name_in_their_own_type(pair):
    _device, client = pair
    client.set_parameter("exposure", 250)
    client.set_parameter("tracking_enable", value=False)
    client.set_parameter("start_mode", "lost_in_space")
    client.set_parameter("limiting_magnitude", 5.5)
    assert client.get_parameter("exposure") == 250
    assert client.get_parameter("tracking_enable") is False
    assert client.get_parameter("start_mode") == "lost_in_space"
    assert client.get_parameter("limiting_magnitude") == 5.5
    with pytest.raises(ProtocolError, match="exposure"):
        client.set_parameter("exposure", 1e9)


def test_waiting_ends_when_the_condition_holds_or_time_runs_out(pair):
    device, client = pair
    device.telemetry["precise_attitude"] = {"valid": False}
    with pytest.raises(BenchError, match="precise_attitude"):
        client.wait_for(
            "precise_attitude", lambda reading: bool(reading["valid"]), within_s=0.1, every_s=0.02
        )
    device.telemetry["precise_attitude"] = {"valid": True, "frame_counter": 7}
    reading = client.wait_for("precise_attitude", lambda reading: bool(reading["valid"]), within_s=1.0)
    assert reading["frame_counter"] == 7


def test_an_image_is_downloaded_frame_by_frame(pair):
    device, client = pair
    device.bad_checksums = 2
    image = client.download_image("size_64")
    assert (image.width, image.height, image.repeats) == (EDGE, EDGE, 2)
    assert image.pixels == device.pixels


def test_a_repeatedly_damaged_frame_ends_the_download(pair):
    device, client = pair
    device.bad_checksums = 1000
    with pytest.raises(BadReplyError, match="image frame 0: checksum"):
        client.download_image("size_64")


def test_an_image_is_downloaded_by_bursts_and_lost_packets_are_asked_for_again(pair):
    device, client = pair
    device.lost_packets = {0, 1, 17, 130, 200}
    image = client.download_image("size_64", method="burst")
    assert (image.width, image.height, image.repeats) == (EDGE, EDGE, 1)
    assert image.pixels == device.pixels


def test_the_files_of_the_device_are_listed(pair):
    _device, client = pair
    (file,) = client.run(list_files(client.core, within_s=1.0))
    assert (file["type"], file["counter"], file["size"]) == (4, 1, len(bmp_file()))


def test_a_wrong_file_checksum_ends_the_download(pair, monkeypatch):
    device, client = pair
    canned = device._telemetry

    def telemetry(name):
        values = canned(name)
        return values | {"crc": values["crc"] ^ 1} if name == "file_info" and values else values

    monkeypatch.setattr(device, "_telemetry", telemetry)
    with pytest.raises(BadReplyError, match="the downloaded file has checksum"):
        client.download_image("size_64", method="burst")


def test_a_telecommand_that_the_serial_line_does_not_answer_is_not_waited_for(hub):
    with FakeDevice() as device:
        with ObcClient.open(serial=device.open_serial(), timeout_s=0.2) as client:
            client.command("reset")
            client.command("reset", magic=0, checked=False)
            client.read("identification")
            assert not client.stray_replies
        with ObcClient.open(can=device.open_can(hub), timeout_s=PATIENCE_S) as client:
            client.command("reset")
            with pytest.raises(NackError, match="invalid_parameter"):
                client.command("reset", magic=0, checked=False)
        assert [name for name, _ in device.received] == ["reset", "reset"]


def test_unsolicited_telemetry_is_a_separate_stream_of_each_row(hub):
    with FakeDevice() as device, ObcClient.open(can=device.open_can(hub), timeout_s=PATIENCE_S) as client:
        client.read("rates")
        for count in range(3):
            device.say("precise_attitude", {"frame_counter": count, "valid": True})
            device.say("rates", {"rate_x": 0.1 * count})
        client.read("identification")
        counts = [client.wait_unsolicited("precise_attitude")["frame_counter"] for _ in range(3)]
        assert counts == [0, 1, 2]
        rates = [client.wait_unsolicited("rates")["rate_x"] for _ in range(3)]
        assert rates == pytest.approx([0.0, 0.1, 0.2], abs=1e-3)
        with pytest.raises(NoReplyError, match="unsolicited"):
            client.wait_unsolicited("precise_attitude", timeout_s=0.05)
        assert not client.stray_replies


def test_raw_bytes_and_frames_can_be_sent(pair):
    device, client = pair
    device.telemetry["boot_status"] = {"boot_count": 0x1F}
    if client.core.link.name == "can":
        answer = ("058104" + "01#001F00000000",)
        sent = [CanFrame(0x04810104)]
    else:
        start, identifier = {Dialect.A: ("7F", "81"), Dialect.B: ("7F", ""), Dialect.C: ("07", "81")}[
            device.dialect
        ]
        answer = (f"1F{start}{identifier}001F1F000000001FFF",)
        sent = [b"\x1f\x7f", b"\x81\x1f\xff"]
    assert client.run(send_and_listen(client.core, sent, 0.0, answer, PATIENCE_S)) == answer


def test_raw_frames_can_be_sent_to_a_canopen_node_of_which_the_answer_is_shown():
    async def scenario():
        node, link = open_can("virtual:raw"), CanopenHostLink(load_unit(), "virtual:raw", node=44)
        answers = [
            CanFrame(can_id, b"\x60", extended=extended)
            for can_id, extended in ((0x5AC, True), (0x5AD, False), (0x5AC, False))
        ]
        await node.start(lambda _frame: [node.send(frame) for frame in answers])
        client = AsyncObcClient(link, load_unit(), timeout_s=PATIENCE_S)
        await client.start()
        try:
            return await send_and_listen(client, [parse_frame("62C#4018100400000000")], 0.0, ["5AC#.."])
        finally:
            await client.close()
            await node.close()

    assert asyncio.run(scenario()) == ("5AC#60",)


def test_ports_that_are_not_available_are_rejected_in_one_line():
    with pytest.raises(ProtocolError, match="/dev/no-such-port"):
        ObcClient.open(serial="/dev/no-such-port")
    with pytest.raises(ProtocolError, match="starhil hub"):
        ObcClient.open(can="socketcand:127.0.0.1:1/vcan0")
    with pytest.raises(BenchError, match="either"):
        ObcClient.open()


def test_a_vanished_port_is_distinguished_from_a_silent_device():
    device = FakeDevice()
    with device, ObcClient.open(serial=device.open_serial(), timeout_s=PATIENCE_S) as client:
        client.read("rates")
        device.close_links()
        with pytest.raises(LinkLostError, match="/dev/pts"):
            client.read("rates", timeout_s=TIMEOUT_S)


def test_unread_unsolicited_telemetry_is_bounded_and_stamped_on_receipt(hub, monkeypatch):
    monkeypatch.setattr("starhil.hil_tests.client.async_client.UNSOLICITED_KEPT", 5)
    with FakeDevice() as device, ObcClient.open(can=device.open_can(hub), timeout_s=PATIENCE_S) as client:
        began = time.monotonic()
        for number in range(8):
            device.say("precise_attitude", {"frame_counter": number})
        client.read("rates")  # on one bus, so all of them have come
        taken = time.monotonic()
        seen = [client.wait_unsolicited("precise_attitude") for _ in range(5)]
        assert [reading["frame_counter"] for reading in seen] == [3, 4, 5, 6, 7]
        assert all(began <= reading.received_s <= taken for reading in seen)
        assert client.core.unsolicited_dropped == 3
        device.say("precise_attitude", {"frame_counter": 8})
        client.read("rates")
        with pytest.raises(NoReplyError):
            client.wait_unsolicited("precise_attitude", since_s=time.monotonic(), timeout_s=0.05)
