"""CANopen conformance: SDO block transfer (CiA 301 7.2.4.3.9 to 7.2.4.3.16)."""

from __future__ import annotations

from binascii import crc_hqx
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import Abort, CanopenProbe
from starhil.hil_tests.conformance.canopen_sdo import (
    LONGEST_TIMEOUT_S,
    expect_no_transfer,
    long_text,
    mux,
    transfer,
    writable_number,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import multiplexer

SDO_BLOCK: Final = CaseArea[CanopenProbe]("canopen.sdo-block", "CiA 301 7.2.4.3.17")
SEGMENT: Final = 7


def _longest_object(probe: CanopenProbe) -> tuple[ODVariable, bytes]:
    """Return the longest readable text or domain of at most 200 kB, preferably of many blocks."""
    best: tuple[ODVariable, bytes] | None = None
    for item in probe.variables():
        if item.readable and item.data_type in {
            datatypes.DOMAIN,
            datatypes.VISIBLE_STRING,
            datatypes.OCTET_STRING,
        }:
            begun = probe.ask(transfer(0x40, item))
            probe.abandon_transfer()
            if begun is None or begun[0] != 0x41:
                continue
            size = int.from_bytes(begun[4:], "little")
            if size <= 200_000 and (best is None or size > len(best[1])):
                best = item, bytes(size)
    if best is None:
        raise CaseSkipped("no readable object of more than 4 bytes")
    item, _ = best
    return item, b""


def _initiate_upload(
    probe: CanopenProbe, item: ODVariable, size: int = 127, *, crc: bool = True, threshold: int = 0
) -> bytes:
    command = 0xA4 if crc else 0xA0
    answer = probe.ask(transfer(command, item, bytes([size, threshold])))
    if answer is None:
        raise CaseFailed("an answer to the block upload", "nothing")
    return answer


def _segments(probe: CanopenProbe, request: bytes, block: int) -> list[bytes]:
    """Send a request, check the sequence numbers of the next block, and return its segments."""
    probe.send_request(request)
    found: list[bytes] = []
    while len(found) < block:
        frame = probe.expect(0x580 + probe.node, f"segment {len(found) + 1} of the block")
        check_equal(frame[0] & 0x7F, len(found) + 1, "segment number")
        found.append(frame)
        if frame[0] & 0x80:
            break
    return found


def upload_blocks(probe: CanopenProbe, item: ODVariable, block: int, *, crc: bool = True) -> bytes:
    """Upload an object in blocks, checking every part of the protocol."""
    answer = _initiate_upload(probe, item, block, crc=crc)
    check(answer[0] & 0xF9 == 0xC0, "answer C0h to C6h", answer)
    check_equal(answer[1:4], multiplexer(item.index, item.subindex), "multiplexer")
    total = int.from_bytes(answer[4:], "little") if answer[0] & 0x02 else None
    with_crc = bool(answer[0] & 0x04) and crc
    data, request = b"", b"\xa3"
    while True:
        found = _segments(probe, request, block)
        data += b"".join(frame[1:] for frame in found)
        request = bytes([0xA2, len(found), block])
        if found[-1][0] & 0x80:
            break
    probe.send_request(request)
    end = probe.expect(0x580 + probe.node, "end of the block upload")
    check(end[0] & 0xE3 == 0xC1, "end C1h to DDh", end)
    unused = end[0] >> 2 & 7
    data = data[: len(data) - unused]
    if total is not None:
        check_equal(len(data), total, "bytes")
    if with_crc:
        check_equal(int.from_bytes(end[1:3], "little"), crc_hqx(data, 0), "CRC")
    probe.send_request(b"\xa1")
    probe.expect_silence(0x580 + probe.node, "answer to the end of an upload", 0.05)
    return data


@SDO_BLOCK.case("upload", "block upload with CRC", "CiA 301 7.2.4.3.13")
def upload_with_crc(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    check_equal(upload_blocks(probe, item, 127), value, "value")
    expect_no_transfer(probe)


@SDO_BLOCK.case("upload-sizes", "block upload in blocks of 1, 2 and 5 segments", "CiA 301 7.2.4.3.13")
def upload_sizes(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    for block in (1, 2, 5):
        check_equal(upload_blocks(probe, item, block), value, "value")


@SDO_BLOCK.case("upload-without-crc", "block upload without CRC", "CiA 301 7.2.4.3.13")
def upload_without_crc(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    check_equal(upload_blocks(probe, item, 127, crc=False), value, "value")


@SDO_BLOCK.case("upload-big", "block upload of many blocks", "CiA 301 7.2.4.3.13")
def upload_big(probe: CanopenProbe) -> None:
    item, _ = _longest_object(probe)
    if len(upload_blocks(probe, item, 100)) <= SEGMENT * 100:
        raise CaseSkipped(f"the longest object, {item.qualname}, fits into one block")


@SDO_BLOCK.case("upload-repeat", "unconfirmed segments are sent again", "CiA 301 7.2.4.3.14")
def upload_repeat(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    _initiate_upload(probe, item, 3)
    first = _segments(probe, b"\xa3", 3)
    again = _segments(probe, bytes([0xA2, 1, 2]), 2)
    check_equal([frame[1:] for frame in again][:1], [first[1][1:]], "second segment again")
    same = _segments(probe, bytes([0xA2, 0, 2]), 2)
    check_equal(same, again, "the same block again")
    check_equal(same[0][1:], value[7:14], "second segment")
    probe.abandon_transfer()


@SDO_BLOCK.case("upload-block-size", "block size 0 and above 127")
def upload_block_size(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    for size in (0, 128):
        probe.check_abort(_initiate_upload(probe, item, size), Abort.BLOCK_SIZE, multiplexer=mux(item))
    for size in (0, 128):
        _initiate_upload(probe, item, 1)
        _segments(probe, b"\xa3", 1)
        probe.check_abort(probe.ask(bytes([0xA2, 1, size])), Abort.BLOCK_SIZE, multiplexer=mux(item))


@SDO_BLOCK.case("upload-sequence", "more segments confirmed than were sent")
def upload_sequence(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    _initiate_upload(probe, item, 2)
    _segments(probe, b"\xa3", 2)
    probe.check_abort(probe.ask("a2 03 02"), Abort.SEQUENCE, multiplexer=mux(item))


@SDO_BLOCK.case("upload-order", "requests of a block upload out of order")
def upload_order(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    for request in ("a2 01 01", "a1", "60"):
        _initiate_upload(probe, item, 1)
        probe.check_abort(probe.ask(request), Abort.COMMAND)
    _initiate_upload(probe, item, 1)
    _segments(probe, b"\xa3", 1)
    probe.check_abort(probe.ask("a1"), Abort.COMMAND)


@SDO_BLOCK.case("threshold", "protocol switch threshold", "CiA 301 7.2.4.3.13")
def threshold(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    answer = _initiate_upload(probe, item, 127, threshold=min(255, len(value)))
    check(answer[0] in {0x41, 0xC6, 0xC4, 0xC2, 0xC0}, "answer 41h or C6h", answer)
    probe.abandon_transfer()
    answer = _initiate_upload(probe, item, 127, threshold=7)
    check(answer[0] & 0xF9 == 0xC0, "answer C6h", answer)
    probe.abandon_transfer()


@SDO_BLOCK.case("upload-refused", "block upload of objects that cannot be read")
def upload_refused(probe: CanopenProbe) -> None:
    probe.expect_abort("a4 05 00 00 7f 00", Abort.NO_OBJECT)
    item = probe.find("write-only object", lambda item: item.access_type == "wo")
    probe.expect_abort(transfer(0xA4, item, b"\x7f\0"), Abort.WRITE_ONLY)


@SDO_BLOCK.case("upload-time-out", "a block upload whose client stops sending times out")
def upload_time_out(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    _initiate_upload(probe, item, 2)
    _segments(probe, b"\xa3", 2)
    probe.check_abort(
        probe.wait_for(0x580 + probe.node, LONGEST_TIMEOUT_S), Abort.TIMEOUT, multiplexer=mux(item)
    )


def _begin_download(probe: CanopenProbe, item: ODVariable, size: int | None, *, crc: bool = True) -> int:
    """Initiate a block download; return the block size requested by the node."""
    command = 0xC0 | (0x04 if crc else 0) | (0 if size is None else 0x02)
    answer = probe.ask(transfer(command, item, (size or 0).to_bytes(4, "little")))
    if answer is None or answer[0] & 0xFB != 0xA0:
        raise CaseFailed("answer A0h or A4h", "nothing" if answer is None else answer.hex(" "))
    check_equal(answer[1:4], multiplexer(item.index, item.subindex), "multiplexer")
    check(1 <= answer[4] <= 127, "block size 1 to 127", answer[4])
    return answer[4]


def _end_download(probe: CanopenProbe, unused: int, crc: int) -> bytes | None:
    return probe.ask(bytes([0xC1 | unused << 2]) + crc.to_bytes(2, "little"))


@SDO_BLOCK.case("download", "block download with CRC", "CiA 301 7.2.4.3.9", intrusive=True)
def download(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    for size, crc, value in ((2, True, b"\x39\x30"), (None, True, b"\x38\x30"), (2, False, b"\x37\x30")):
        _begin_download(probe, item, size, crc=crc)
        answer = probe.ask(b"\x81" + value)
        check(answer is not None and answer[:2] == b"\xa2\x01", "confirmation A2h 01h", answer)
        answer = _end_download(probe, 5, crc_hqx(value, 0) if crc else 0)
        check_equal(answer, b"\xa1" + bytes(7), "end")
        check_equal(probe.read(item.index, item.subindex), value, "value")
    expect_no_transfer(probe)


@SDO_BLOCK.case("download-crc", "wrong CRC of a block download", intrusive=True)
def download_crc(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    before = probe.read(item.index, item.subindex)
    value = bytes([before[0] ^ 1, before[1]])
    _begin_download(probe, item, 2)
    probe.ask(b"\x81" + value)
    probe.check_abort(_end_download(probe, 5, crc_hqx(value, 0) ^ 0x0100), Abort.CRC, multiplexer=mux(item))
    check_equal(probe.read(item.index, item.subindex), before, "value as before")


@SDO_BLOCK.case("download-gap", "a lost segment is requested again", "CiA 301 7.2.4.3.11", intrusive=True)
def download_gap(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    _begin_download(probe, item, 2)
    answer = probe.ask(b"\x82\x39\x30")
    check(answer is not None and answer[:2] == b"\xa2\x00", "confirmation A2h 00h", answer)
    answer = probe.ask(b"\x81\x39\x30")
    check(answer is not None and answer[:2] == b"\xa2\x01", "confirmation A2h 01h", answer)
    answer = _end_download(probe, 5, crc_hqx(b"\x39\x30", 0))
    check_equal(answer, b"\xa1" + bytes(7), "end")


@SDO_BLOCK.case("download-zero", "segment number 0", intrusive=True)
def download_zero(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    _begin_download(probe, item, 2)
    answer = probe.ask(b"\x00\x39\x30")
    if answer is not None:
        probe.check_abort(answer, Abort.SEQUENCE, multiplexer=mux(item))
    else:
        probe.abandon_transfer()
    probe.expect_answer("40 00 10 00", "43 00 10 00 .. .. .. ..")


@SDO_BLOCK.case("download-length", "block downloads of wrong length", intrusive=True)
def download_length(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    before = probe.read(item.index, item.subindex)
    for size, unused in ((None, 4), (None, 6), (2, 6)):
        _begin_download(probe, item, size, crc=False)
        probe.ask(b"\x81\x39\x30\x01")
        probe.check_abort(
            _end_download(probe, unused, 0),
            Abort.LENGTH,
            Abort.LENGTH_HIGH,
            Abort.LENGTH_LOW,
            multiplexer=mux(item),
        )
    check_equal(probe.read(item.index, item.subindex), before, "value as before")


@SDO_BLOCK.case(
    "download-announced", "announced size that differs from the size of the object", intrusive=True
)
def download_announced(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    answer = probe.ask(transfer(0xC2, item, b"\x03\0\0\0"))
    if answer is not None and answer[0] != 0x80:
        probe.ask(b"\x81\x39\x30\x01")
        answer = _end_download(probe, 4, 0)
    probe.check_abort(answer, Abort.LENGTH, Abort.LENGTH_HIGH, multiplexer=mux(item))


@SDO_BLOCK.case("download-abort", "an abort by the client ends a block download", intrusive=True)
def download_abort(probe: CanopenProbe) -> None:
    """80h is not a segment."""
    item = writable_number(probe)
    _begin_download(probe, item, 2)
    probe.send(0x600 + probe.node, transfer(0x80, item, bytes.fromhex("00000405")))
    probe.expect_silence(0x580 + probe.node, "answer to an abort")
    expect_no_transfer(probe)


@SDO_BLOCK.case("download-refused", "block download to objects that cannot be written", intrusive=True)
def download_refused(probe: CanopenProbe) -> None:
    probe.expect_abort("c2 00 10 00 04 00 00 00", Abort.READ_ONLY)
    probe.expect_abort("c2 05 00 00 04 00 00 00", Abort.NO_OBJECT)
