"""SDO server frame by frame: what CiA 301 says for each request.

Toggle bits, frames of others and aborts by the client are conformance cases (`canopen_sdo_cases.toml`).
"""

from __future__ import annotations

from binascii import crc_hqx
from unittest.mock import Mock

import canopen
import pytest

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred

ATTITUDE = "00 20 a0"  # 2000h:160, precise_attitude as a whole
SERIAL_DIALECT = "20 60 24"  # 6020h:36
EXPOSURE = "20 60 01"  # 6020h:1, u16, 1 to 5000
SAVE_IMAGE = "42 60 00"  # OCTET_STRING of 2 bytes
NAME = "08 10 00"


def abort(mux: str, code: AbortCode) -> str:
    return "80" + mux.replace(" ", "") + code.to_bytes(4, "little").hex()


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("40 00 10 00", "43001000 00000000"),  # 1000h, 4 bytes expedited
        ("40 01 10 00", "4f011000 00000000"),  # 1001h, 1 byte
        ("40 17 10 00", "4b171000 e8030000"),  # 1017h, 2 bytes: 1000 ms
        ("40 18 10 00", "4f181000 04000000"),
        ("40 18 10 02", "43181002 52415453"),  # product code "STAR"
        ("40 00 12 01", "43001201 2c060000"),
        ("40 00 12 02", "43001202 ac050000"),
        ("40 05 10 00", "43051000 80000000"),
        ("40 14 10 00", "43141000 ac000000"),
        ("40 00 14 01", "43001401 2c020000"),
        ("40 00 18 01", "43001801 ac010040"),
        ("40 " + EXPOSURE, "4b206001 64000000"),
        ("2b 17 10 00 f4 01", "60171000 00000000"),  # 2 bytes, size given
        ("22 17 10 00 f4 01", "60171000 00000000"),  # size not given: the object's own
        ("2b " + EXPOSURE + " c8 00", "60206001 00000000"),
        ("2f " + SERIAL_DIALECT + " 02", "60206024 00000000"),
    ],
)
def test_expedited(bench, request_, answer):
    assert bench.sdo(request_) == answer.replace(" ", "")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("40 00 0f 00", AbortCode.NO_OBJECT),
        ("40 ff ff 00", AbortCode.NO_OBJECT),
        ("40 05 00 00", AbortCode.NO_OBJECT),  # data types are no objects of the dictionary
        ("23 00 50 00 01 00 00 00", AbortCode.NO_OBJECT),
        ("40 18 10 05", AbortCode.NO_SUBINDEX),
        ("40 00 10 01", AbortCode.NO_SUBINDEX),  # a variable has sub-index 0 only
        ("2f 18 10 09 01", AbortCode.NO_SUBINDEX),
        ("23 00 10 00 01 00 00 00", AbortCode.READ_ONLY),
        ("2f 18 10 00 05", AbortCode.READ_ONLY),
        ("23 08 10 00 41 41 41 41", AbortCode.READ_ONLY),  # const
        ("40 42 60 00", AbortCode.WRITE_ONLY),
        ("40 51 60 00", AbortCode.WRITE_ONLY),
        ("2f 17 10 00 01", AbortCode.LENGTH_LOW),
        ("23 17 10 00 01 00 00 00", AbortCode.LENGTH_HIGH),
        ("23 0d 10 00 01 00 00 00", AbortCode.LENGTH_HIGH),
        ("2b " + EXPOSURE + " 00 00", AbortCode.VALUE_LOW),
        ("2b " + EXPOSURE + " 89 13", AbortCode.VALUE_HIGH),  # 5001
        ("2f " + SERIAL_DIALECT + " 03", AbortCode.VALUE_HIGH),
        ("2f 00 60 00 00", AbortCode.VALUE_RANGE),  # mode 0 cannot be commanded
        ("23 20 60 02 00 00 c0 7f", AbortCode.VALUE_RANGE),  # NaN
        ("2f 51 60 00 00", AbortCode.VALUE_LOW),
        ("2f 29 10 01 03", AbortCode.VALUE_HIGH),
        ("2f 42 60 00 02", AbortCode.LENGTH_LOW),
        ("2b 42 60 00 07 00", AbortCode.VALUE_RANGE),  # no such camera
        ("40 40 60 01", AbortCode.NO_DATA),  # no image yet
        ("40 03 10 01", AbortCode.NO_DATA),  # no error in the history
        ("2f 03 10 00 01", AbortCode.VALUE_RANGE),
        ("2f 19 10 00 01", AbortCode.VALUE_RANGE),
        ("23 10 10 01 73 61 76 66", AbortCode.NOT_STORED),
        ("23 11 10 01 73 61 76 65", AbortCode.NOT_STORED),
    ],
)
def test_abort_codes_of_expedited_requests(bench, request_, code):
    mux = "".join(request_.split()[1:4])
    assert bench.sdo(request_) == abort(mux, code)


def test_segmented_upload_with_size_and_toggle(bench):
    text = b"CubeStar-like star sensor"
    assert bench.sdo("40" + NAME) == "41081000" + len(text).to_bytes(4, "little").hex()
    assert bench.sdo("60") == "00" + text[:7].hex()
    assert bench.sdo("70") == "10" + text[7:14].hex()
    assert bench.sdo("60") == "00" + text[14:21].hex()
    assert bench.sdo("70") == "17" + text[21:].hex() + "000000"
    assert bench.sdo("60") == abort("000000", AbortCode.COMMAND)


def test_segmented_upload_of_exactly_seven_bytes(bench):
    bench.show(b"1234567")
    assert bench.sdo("40 40 60 01") == "4140600107000000"
    assert bench.sdo("60") == "01" + b"1234567".hex()


def test_segmented_upload_of_nothing(bench):
    bench.show(b"")
    assert bench.sdo("40 40 60 01") == "4140600100000000"
    assert bench.sdo("60") == "0f" + "00" * 7


def test_segmented_download(bench):
    assert bench.sdo("21 00 20 62 09 00 00 00") == "6000206200000000"  # set_parameter, 9 bytes
    assert bench.sdo("00 01 00 00 00 00 00 00") == "2000000000000000"
    assert bench.sdo("1b 69 40") == "3000000000000000"
    assert bench.application.commands == [("set_parameter", {"parameter": 1, "value": 200.0})]


def test_segmented_download_without_a_size(bench):
    bench.sdo("20 42 60 00")
    assert bench.sdo("0b 02 03") == "2000000000000000"
    assert bench.application.commands == [("save_image", {"camera": "star", "image_size": "size_128"})]


@pytest.mark.parametrize(
    ("initiate", "segment", "code"),
    [
        ("21 42 60 00 03", None, AbortCode.LENGTH_HIGH),  # announced: more than the object takes
        ("20 42 60 00", "09 02 03 04", AbortCode.LENGTH_HIGH),  # sent: more than the object takes
        ("20 42 60 00", "0d 02", AbortCode.LENGTH_LOW),
        ("21 42 60 00 01", "0b 02 03", AbortCode.LENGTH),  # more than announced
        ("21 42 60 00 02", "0d 02", AbortCode.LENGTH),  # fewer than announced
        ("21 17 10 00 03", None, AbortCode.LENGTH_HIGH),
        ("21 17 10 00 01", None, AbortCode.LENGTH_LOW),
        ("20 17 10 00", "09 02 03 04", AbortCode.LENGTH_HIGH),
        ("21 00 10 00 04", None, AbortCode.READ_ONLY),
        ("21 99 50 00 04", None, AbortCode.NO_OBJECT),
    ],
)
def test_lengths_of_segmented_downloads(bench, initiate, segment, code):
    mux = "".join(initiate.split()[1:4])
    answer = bench.sdo(initiate)
    if segment is not None:
        assert answer.startswith("60")
        answer = bench.sdo(segment)
    assert answer == abort(mux, code)
    assert bench.sdo("01") == abort("000000", AbortCode.COMMAND)


@pytest.mark.parametrize("request_", ["00", "01", "60", "70", "e0", "a1", "a2", "a3", "c1", "ff"])
def test_requests_that_need_a_transfer_or_do_not_exist(bench, request_):
    assert bench.sdo(request_) == abort("000000", AbortCode.COMMAND)


def test_wrong_specifier_within_a_transfer_ends_it(bench):
    bench.sdo("40" + NAME)
    assert bench.sdo("00") == abort(NAME, AbortCode.COMMAND)
    bench.sdo("21 42 60 00 02")
    assert bench.sdo("60") == abort("426000", AbortCode.COMMAND)
    bench.sdo("40" + NAME)
    assert bench.sdo("e0") == abort(NAME, AbortCode.COMMAND)


def test_silent_client_times_out(bench):
    bench.sdo("40" + NAME)
    assert bench.slave.next_deadline() == bench.now + 1.0
    assert (bench.now + 1.0, 0x5AC, bytes.fromhex(abort(NAME, AbortCode.TIMEOUT))) in bench.advance(1.0)
    assert bench.sdo("60") == abort("000000", AbortCode.COMMAND)
    assert not [sent for sent in bench.advance(3.0) if sent[1] == 0x5AC]


def test_every_request_restarts_the_timeout(bench):
    bench.sdo("40" + NAME)
    bench.advance(0.9)
    assert bench.sdo("60").startswith("00")
    bench.advance(0.9)
    assert bench.sdo("70").startswith("10")


def test_no_answer_in_stopped_and_a_transfer_does_not_survive_it(bench):
    bench.sdo("40" + NAME)
    bench.nmt(2)
    assert bench.sdo("60") == ""
    assert bench.sdo("40 00 10 00") == ""
    assert not [sent for sent in bench.advance(2.0) if sent[1] == 0x5AC]
    bench.nmt(128)
    assert bench.sdo("60") == abort("000000", AbortCode.COMMAND)


def test_no_answer_before_start(new_bench):
    assert new_bench().sdo("40 00 10 00") == ""


# Block transfer


def upload_block(bench, size: int, crc: bool = True) -> bytes:
    """Upload 6040h in blocks of `size`; check sequence numbers, end and CRC."""
    answer = bytes.fromhex(bench.sdo(bytes([0xA4 if crc else 0xA0, 0x40, 0x60, 1, size, 0])))
    assert answer[:4] == bytes([0xC6, 0x40, 0x60, 1])
    total = int.from_bytes(answer[4:], "little")
    data, answers = b"", bench.frame(0x62C, b"\xa3" + bytes(7))
    while True:
        numbers = [frame[0] for _, frame in answers]
        assert [number & 0x7F for number in numbers] == list(range(1, len(numbers) + 1))
        assert not any(number & 0x80 for number in numbers[:-1])
        data += b"".join(frame[1:] for _, frame in answers)
        answers = bench.frame(0x62C, bytes([0xA2, len(numbers), size, 0, 0, 0, 0, 0]))
        if numbers[-1] & 0x80:
            break
    ((_, end),) = answers
    assert end[0] & 0xE3 == 0xC1
    data = data[: len(data) - (end[0] >> 2 & 7)]
    assert int.from_bytes(end[1:3], "little") == (crc_hqx(data, 0) if crc else 0)
    assert bench.frame(0x62C, b"\xa1" + bytes(7)) == []
    assert len(data) == total
    return data


@pytest.mark.parametrize("length", [0, 1, 6, 7, 8, 14, 888, 889, 890, 2000])
@pytest.mark.parametrize("size", [1, 5, 127])
def test_block_upload(bench, length, size):
    data = bench.show(bytes(number * 7 & 0xFF for number in range(length)))
    assert upload_block(bench, size, crc=size != 5) == data
    assert bench.sdo("a1") == abort("000000", AbortCode.COMMAND)


def test_block_upload_repeats_unconfirmed_segments(bench):
    data = bench.show(bytes(range(70)))
    bench.sdo("a4 40 60 01 05 00")
    first = bench.frame(0x62C, b"\xa3" + bytes(7))
    assert first[-1][1] == bytes([5]) + data[28:35]
    again = bench.frame(0x62C, bytes([0xA2, 2, 3, 0, 0, 0, 0, 0]))
    assert [frame for _, frame in again] == [bytes([n + 1]) + data[14 + 7 * n : 21 + 7 * n] for n in range(3)]
    nothing = bench.frame(0x62C, bytes([0xA2, 0, 4, 0, 0, 0, 0, 0]))
    assert [frame for _, frame in nothing] == [
        bytes([n + 1]) + data[14 + 7 * n : 21 + 7 * n] for n in range(4)
    ]


def test_block_upload_repeats_the_last_segment(bench):
    bench.show(b"0123456789")
    bench.sdo("a4 40 60 01 7f 00")
    bench.frame(0x62C, b"\xa3" + bytes(7))
    assert bench.sdo("a2 01 7f") == "81" + b"789".hex() + "00000000"
    assert bench.sdo("a2 01 7f").startswith("d1")  # 4 unused bytes


@pytest.mark.parametrize(
    ("requests", "code"),
    [
        (["a4 40 60 01 00 00"], AbortCode.BLOCK_SIZE),
        (["a4 40 60 01 80 00"], AbortCode.BLOCK_SIZE),
        (["a4 40 60 01 05 00", "a3", "a2 02 00"], AbortCode.BLOCK_SIZE),
        (["a4 40 60 01 05 00", "a3", "a2 02 80"], AbortCode.BLOCK_SIZE),
        (["a4 40 60 01 05 00", "a3", "a2 06 05"], AbortCode.SEQUENCE),
        (["a4 40 60 01 05 00", "a2 01 05"], AbortCode.COMMAND),
        (["a4 40 60 01 05 00", "a1"], AbortCode.COMMAND),
        (["a4 40 60 01 05 00", "a3", "a3"], AbortCode.COMMAND),
        (["a4 40 60 01 05 00", "a3", "a1"], AbortCode.COMMAND),
        (["a4 40 60 01 05 00", "a3", "60"], AbortCode.COMMAND),
        (["a4 40 60 01 7f 00", "a3", "a2 0f 7f", "a2 0f 7f"], AbortCode.COMMAND),
    ],
)
def test_faults_of_block_uploads(bench, requests, code):
    bench.show(bytes(100))
    for request in requests[:-1]:
        bench.sdo(request)
    assert bench.sdo(requests[-1]) == abort("406001", code)


def test_block_upload_of_an_unreadable_object_is_aborted(bench):
    assert bench.sdo("a4 40 60 01 7f 00") == abort("406001", AbortCode.NO_DATA)
    assert bench.sdo("a4 42 60 00 7f 00") == abort("426000", AbortCode.WRITE_ONLY)
    assert bench.sdo("a4 99 50 00 7f 00") == abort("995000", AbortCode.NO_OBJECT)


@pytest.mark.parametrize(
    ("length", "threshold", "answer"),
    [
        (10, 10, "41406001 0a000000"),
        (10, 9, "c6406001 0a000000"),
        (4, 20, "43406001 00000000"),
        (4, 0, "c6406001 04000000"),
    ],
)
def test_protocol_switch_threshold(bench, length, threshold, answer):
    bench.show(bytes(length))
    assert bench.sdo(bytes([0xA4, 0x40, 0x60, 1, 0x7F, threshold])) == answer.replace(" ", "")


def test_block_transfer_times_out(bench):
    bench.show(bytes(100))
    bench.sdo("a4 40 60 01 7f 00")
    bench.frame(0x62C, b"\xa3" + bytes(7))
    assert bytes.fromhex(abort("406001", AbortCode.TIMEOUT)) in [data for _, _, data in bench.advance(1.0)]


PARAMETER = b"\x01" + bytes.fromhex("0000000000006940")  # set_parameter: exposure 200


def download_block(bench, data: bytes, crc: int | None = None, **faults) -> str:
    """Download 9 bytes to 2000h:98 in one block; return the answer to the end."""
    announced = faults.get("announced", len(data))
    initiate = bytes([0xC6 if crc is not None else 0xC2, 0, 0x20, 98]) + announced.to_bytes(4, "little")
    answer = bench.sdo(initiate)
    if not answer.startswith("a4"):
        return answer
    assert answer == "a40020627f000000"
    padded = data + bytes(-len(data) % 7)
    segments = [padded[start : start + 7] for start in range(0, len(padded), 7)]
    for number, segment in enumerate(segments[:-1], 1):
        assert bench.sdo(bytes([number]) + segment) == ""
    last = len(segments)
    assert bench.sdo(bytes([0x80 | last]) + segments[-1]) == f"a2{last:02x}7f0000000000"
    return bench.sdo(bytes([0xC1 | (len(padded) - len(data)) << 2]) + (crc or 0).to_bytes(2, "little"))


def test_block_download(bench):
    assert download_block(bench, PARAMETER, crc_hqx(PARAMETER, 0)) == "a100000000000000"
    assert bench.application.commands == [("set_parameter", {"parameter": 1, "value": 200.0})]


def test_block_download_without_crc(bench):
    assert download_block(bench, PARAMETER) == "a100000000000000"


@pytest.mark.parametrize(
    ("data", "crc", "faults", "code"),
    [
        (PARAMETER, crc_hqx(PARAMETER, 0) ^ 1, {}, AbortCode.CRC),
        (PARAMETER[:8], None, {}, AbortCode.LENGTH_LOW),
        (PARAMETER + b"\0", None, {}, AbortCode.LENGTH_HIGH),
        (PARAMETER[:8], None, {"announced": 9}, AbortCode.LENGTH),
    ],
)
def test_faults_of_block_downloads(bench, data, crc, faults, code):
    assert download_block(bench, data, crc, **faults) == abort("002062", code)
    assert bench.application.commands == []


def test_block_download_asks_for_the_rest_after_a_gap(bench):
    bench.sdo("c2 00 20 62 09 00 00 00")
    assert bench.sdo(bytes([0x82]) + PARAMETER[7:]) == "a2007f0000000000"  # first segment lost
    assert bench.sdo(bytes([0x01]) + PARAMETER[:7]) == ""
    assert bench.sdo(bytes([0x82]) + PARAMETER[7:]) == "a2027f0000000000"
    assert bench.sdo(bytes([0xC1 | 5 << 2])) == "a100000000000000"
    assert bench.application.commands == [("set_parameter", {"parameter": 1, "value": 200.0})]


def test_gap_within_a_full_block(bench):
    bench.sdo("c0 00 20 62")
    bench.sdo(bytes([1]) + bytes(7))
    for number in range(3, 127):
        assert bench.sdo(bytes([number]) + bytes(7)) == ""
    assert bench.sdo(bytes([127]) + bytes(7)) == "a2017f0000000000"


def test_segment_number_zero(bench):
    bench.sdo("c2 00 20 62 09 00 00 00")
    assert bench.sdo("00 01 02") == abort("002062", AbortCode.SEQUENCE)


def test_block_download_too_long_for_the_object(bench):
    bench.sdo("c0 00 20 62")
    answers = [bench.sdo(bytes([number]) + bytes(7)) for number in range(1, 5)]
    assert abort("002062", AbortCode.LENGTH_HIGH) in answers


def test_block_download_end_before_its_time(bench):
    bench.sdo("c2 00 20 62 09 00 00 00")
    bench.sdo(bytes([1]) + PARAMETER[:7])
    bench.sdo(bytes([0x82]) + PARAMETER[7:])
    assert bench.sdo("60") == abort("002062", AbortCode.COMMAND)


def test_block_download_is_aborted_for_a_read_only_object_or_a_wrong_size(bench):
    assert bench.sdo("c2 00 10 00 04") == abort("001000", AbortCode.READ_ONLY)
    assert bench.sdo("c2 17 10 00 04") == abort("171000", AbortCode.LENGTH_HIGH)


def test_refusal_of_the_device(bench):
    def refuse(row, payload):
        raise SdoAbortError(AbortCode.DEVICE_STATE, row.name)

    bench.application.telecommand = refuse
    assert bench.sdo("2f 00 60 00 03") == abort("006000", AbortCode.DEVICE_STATE)


def test_other_errors_of_the_device_are_a_general_abort_and_an_event(bench):
    from starhil.protocol.errors import ProtocolError

    def fail(row):
        raise ProtocolError("no such thing")

    bench.application.telemetry = fail
    bench.slave.take_events()
    assert bench.sdo("40 00 60 00") == abort("006000", AbortCode.GENERAL)
    (event,) = bench.slave.take_events()
    assert "6000h:00h: no such thing" in event.detail


def test_image_record(bench):
    bench.show(b"abc")
    assert bench.read(0x6040, 1) == b"abc"
    assert [bench.number(0x6040, subindex) for subindex in (2, 3, 4)] == [3, 1, 7]
    assert bench.write(0x6040, 5, 1, 1) == 0
    assert bench.application.taken == ["frame"]
    assert bench.sdo("40 43 60 01") == abort("436001", AbortCode.NO_DATA)


# Writes whose result comes later


@pytest.fixture
def later(bench):
    """A device that accepts a mode command and reports its result later."""
    deferred = Deferred()
    bench.application.telecommand = Mock(return_value=deferred)
    return deferred


def finish(bench, deferred, refusal=None):
    return [(frame.id, frame.data.hex()) for frame in bench.slave.finish_write(deferred, bench.now, refusal)]


def test_deferred_write_is_answered_when_it_is_done(bench, later):
    assert bench.sdo("2f 00 60 00 02") == ""
    assert finish(bench, Deferred()) == []
    assert finish(bench, later) == [(0x5AC, "6000600000000000")]
    assert finish(bench, later) == []


def test_deferred_write_refused_after_all(bench, later):
    bench.sdo("2f 00 60 00 02")
    refusal = SdoAbortError(AbortCode.HARDWARE)
    assert finish(bench, later, refusal) == [(0x5AC, abort("006000", AbortCode.HARDWARE))]


def test_deferred_segmented_and_block_download(bench, later):
    bench.sdo("20 42 60 00")
    assert bench.sdo("0b 02 03") == ""
    assert finish(bench, later) == [(0x5AC, "2000000000000000")]
    bench.sdo("c2 42 60 00 02")
    bench.sdo("81 02 03")
    assert bench.sdo("d5") == ""
    assert finish(bench, later) == [(0x5AC, "a100000000000000")]


DEFERRED_WRITES = pytest.mark.parametrize(
    ("requests", "answer"),
    [
        (["2f 00 60 00 02"], "6000600000000000"),
        (["20 42 60 00", "0b 02 03"], "2000000000000000"),
        (["c2 42 60 00 02", "81 02 03", "d5"], "a100000000000000"),
    ],
    ids=["expedited", "segmented", "block"],
)


@DEFERRED_WRITES
def test_result_may_come_later_than_a_client_may_be_silent(bench, later, requests, answer):
    for request in requests:
        bench.sdo(request)
    assert not [sent for sent in bench.advance(29.9) if sent[1] == 0x5AC]
    assert finish(bench, later) == [(0x5AC, answer)]


def test_deferred_write_times_out(bench, later):
    bench.sdo("2f 00 60 00 02")
    answers = [(i, d.hex()) for _, i, d in bench.advance(30.0) if i == 0x5AC]
    assert answers == [(0x5AC, abort("006000", AbortCode.TIMEOUT))]
    assert finish(bench, later) == []


def test_silent_client_times_out_again_after_a_deferred_write(bench, later):
    bench.sdo("2f 00 60 00 02")
    finish(bench, later)
    bench.sdo("40" + NAME)
    assert bench.slave.next_deadline() == bench.now + 1.0


@pytest.mark.parametrize("request_", ["40 01 10 00", "80 00 60 00"])
def test_client_that_no_longer_waits(bench, later, request_):
    bench.sdo("2f 00 60 00 02")
    bench.sdo(request_)
    assert finish(bench, later) == []


def test_request_out_of_place_while_waiting(bench, later):
    bench.sdo("2f 00 60 00 02")
    assert bench.sdo("60") == abort("006000", AbortCode.COMMAND)
    assert finish(bench, later) == []


def test_abort_codes_are_those_of_the_library():
    assert {int(code) for code in AbortCode} <= set(canopen.SdoAbortedError.CODES)
