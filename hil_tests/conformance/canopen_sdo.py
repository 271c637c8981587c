"""CANopen conformance: the SDO server, with expedited, segmented and block transfer (CiA 301 7.2.4)."""

from __future__ import annotations

from binascii import crc_hqx
from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_dialogue import (
    Dialogue,
    add_dialogues,
    long_text,
    mux,
    writable_number,
)
from starhil.hil_tests.conformance.canopen_probe import Abort, CanopenProbe, check_abort, is_integer, size_of
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import SDO_RESPONSE, multiplexer, upload_request

SDO: Final = CaseArea[CanopenProbe]("canopen.sdo", "CiA 301 7.2.4.3.17")
SDO_BLOCK: Final = CaseArea[CanopenProbe]("canopen.sdo-block", "CiA 301 7.2.4.3.17")
SEGMENT: Final = 7

DIALOGUES: Final = (
    Dialogue("expedited-download", "expedited download is confirmed", "2b {number} 39 30 > 60 {number} 00000000; value 39 30", "CiA 301 7.2.4.3.3", intrusive=True),
    Dialogue("no-size", "expedited download without a size", "22 {number} 39 30 > 60 {number} 00000000; value 39 30", "CiA 301 7.2.4.3.3", intrusive=True),
    Dialogue("upload-toggle", "toggle bit not alternated in an upload", "40 {text} > *; 70 > abort TOGGLE {text}; 60 > abort COMMAND; 40 {text} > *; 60 > *; 60 > abort TOGGLE {text}; 60 > abort COMMAND"),
    Dialogue(
        "segmented-download", "segmented download of a number",
        "21 {number} 02 > 60 {number} 00000000; 0b 39 30 > 20 00000000000000; value 39 30; 20 {number} > 60 {number} 00000000; 0b 38 30 > 20 00000000000000; "
        "value 38 30",
        "CiA 301 7.2.4.3.4", intrusive=True,
    ),
    Dialogue("download-in-parts", "segmented download in two segments", "21 {number} 02 > *; 0c {low} > 20 00000000000000; 1d {high} > 30 00000000000000; value {new}", "CiA 301 7.2.4.3.4", intrusive=True),
    Dialogue(
        "download-toggle", "toggle bit not alternated in a download",
        "21 {number} 02 > *; 1b 11 11 > abort TOGGLE {number}; 01 > abort COMMAND; 21 {number} 02 > *; 0c 11 > *; 0d 11 > abort TOGGLE {number}; kept",
        intrusive=True,
    ),
    Dialogue("announced-high", "announced size larger than the object", "21 {number} 03 > unless abort LENGTH|LENGTH_HIGH {number}; 09 01 01 01 > abort LENGTH|LENGTH_HIGH {number}", intrusive=True),
    Dialogue("sent-high", "more bytes sent than the object has", "20 {number} > *; 09 01 01 01 > abort LENGTH|LENGTH_HIGH {number}", intrusive=True),
    Dialogue("sent-low", "fewer bytes sent than the object has", "20 {number} > *; 0d {low} > abort LENGTH|LENGTH_LOW {number}; kept", intrusive=True),
    Dialogue("announced-differs", "fewer bytes sent than announced", "21 {number} 02 > *; 0d 01 > abort LENGTH|LENGTH_HIGH|LENGTH_LOW {number}", intrusive=True),
    Dialogue("unknown-command", "unknown command specifier", "e0 00 10 00 > abort COMMAND"),
    Dialogue(
        "no-transfer", "segments without a transfer",
        "60 > abort COMMAND; 70 > abort COMMAND; 00 > abort COMMAND; 01 > abort COMMAND; a1 > abort COMMAND; a2 01 7f > abort COMMAND; a3 > abort COMMAND; "
        "c1 > abort COMMAND",
    ),
    Dialogue("wrong-segment", "download segment within an upload", "40 {text} > *; 00 > abort COMMAND; 60 > abort COMMAND"),
    Dialogue("client-abort", "an abort by the client ends the transfer and is not answered", "40 {text} > *; 80 {text} 00000405 > silence; 60 > abort COMMAND"),
    Dialogue("new-request", "a new request replaces the active transfer", "40 {text} > *; 60 > *; 40 00 10 00 > 43 00 10 00 .. .. .. ..; 60 > abort COMMAND", "CiA 301 7.2.4.3.6"),
    Dialogue("time-out", "a transfer whose client stops sending times out", "40 {text} > *; wait > abort TIMEOUT {text}; 60 > abort COMMAND"),
    Dialogue("server-parameter", "1200h holds the CAN IDs in use", "need 1200; holds 1200:1 0x{request}; holds 1200:2 0x{response}", "CiA 301 7.5.2.33"),
    Dialogue("stopped", "no SDO in STOPPED", "40 {text} > *; nmt 2; 60 > silence; 40 00 10 00 > silence", "CiA 301 7.3.2.2.5", intrusive=True),
)  # fmt: skip
READ: Final = "40 00 10 00 00 00 00 00"
IGNORED: Final = (
    Dialogue(
        "wrong-length", "frames with a length other than 8 bytes are ignored",
        "send {request}; none {response}; send {request} 40001000; none {response}; send {request} 40001000000000; none {response}",
        "CiA 301 7.2.4.3.2",
    ),
    Dialogue("extended", "frames with a 29-bit CAN ID are ignored", f"send {{request}} {READ} extended; none {{response}}", "CiA 301 7.3.5"),
    Dialogue("remote", "remote frames are ignored", "send {request} remote; none {response}", "CiA 301 7.2.4"),
    Dialogue("other-node", "requests to another node are not answered", f"send {{other_request}} {READ}; none {{response}}", "CiA 301 7.3.5"),
)  # fmt: skip
"""Frames that are not requests to the node."""
BLOCK_DIALOGUES: Final = (
    Dialogue(
        "upload-block-size", "block size 0 and above 127",
        "a4 {text} 00 > abort BLOCK_SIZE {text}; a4 {text} 80 > abort BLOCK_SIZE {text}; a4 {text} 01 > *; a3 > segment 1; a2 01 00 > abort BLOCK_SIZE {text}; "
        "a4 {text} 01 > *; a3 > segment 1; a2 01 80 > abort BLOCK_SIZE {text}",
    ),
    Dialogue("upload-sequence", "more segments confirmed than were sent", "a4 {text} 02 > *; a3 > segment 1; > segment 2; a2 03 02 > abort SEQUENCE {text}"),
    Dialogue(
        "upload-order", "requests of a block upload out of order",
        "a4 {text} 01 > *; a2 01 01 > abort COMMAND; a4 {text} 01 > *; a1 > abort COMMAND; a4 {text} 01 > *; 60 > abort COMMAND; a4 {text} 01 > *; "
        "a3 > segment 1; a1 > abort COMMAND",
    ),
    Dialogue("upload-refused", "block upload of objects that cannot be read", "a4 05 00 00 7f > abort NO_OBJECT 050000; a4 {write_only} 7f > abort WRITE_ONLY {write_only}"),
    Dialogue("upload-time-out", "a block upload whose client stops sending times out", "a4 {text} 02 > *; a3 > segment 1; > segment 2; wait > abort TIMEOUT {text}"),
    Dialogue(
        "download", "block download with CRC",
        "c6 {number} 02 > block {number}; 81 39 30 > a2 01 *; d5 5e 89 > a1 00000000000000; value 39 30; c4 {number} > block {number}; 81 38 30 > a2 01 *; "
        "d5 6f ba > a1 00000000000000; value 38 30; c2 {number} 02 > block {number}; 81 37 30 > a2 01 *; d5 > a1 00000000000000; value 37 30; "
        "60 > abort COMMAND",
        "CiA 301 7.2.4.3.9", intrusive=True,
    ),
    Dialogue("download-crc", "wrong CRC of a block download", "c6 {number} 02 > block {number}; 81 {new} > *; d5 {bad_crc} > abort CRC {number}; kept", intrusive=True),
    Dialogue("download-gap", "a lost segment is requested again", "c6 {number} 02 > block {number}; 82 {new} > a2 00 *; 81 {new} > a2 01 *; d5 {crc} > a1 00000000000000", "CiA 301 7.2.4.3.11", intrusive=True),
    Dialogue(
        "download-length", "block downloads of wrong length",
        "c0 {number} > block {number}; 81 39 30 01 > *; d1 > abort LENGTH|LENGTH_HIGH|LENGTH_LOW {number}; c0 {number} > block {number}; 81 39 30 01 > *; "
        "d9 > abort LENGTH|LENGTH_HIGH|LENGTH_LOW {number}; c2 {number} 02 > block {number}; 81 39 30 01 > *; "
        "d9 > abort LENGTH|LENGTH_HIGH|LENGTH_LOW {number}; kept",
        intrusive=True,
    ),
    Dialogue(
        "download-announced", "announced size that differs from the size of the object",
        "c2 {number} 03 > unless abort LENGTH|LENGTH_HIGH {number}; 81 39 30 01 > *; d1 > abort LENGTH|LENGTH_HIGH {number}",
        intrusive=True,
    ),
    Dialogue("download-abort", "an abort by the client ends a block download", "c6 {number} 02 > block {number}; 80 {number} 00000405 > silence; 60 > abort COMMAND", intrusive=True),
    Dialogue("download-refused", "block download to objects that cannot be written", "c2 00 10 00 04 > abort READ_ONLY 001000; c2 05 00 00 04 > abort NO_OBJECT 050000", intrusive=True),
)  # fmt: skip
add_dialogues(SDO, (*DIALOGUES, *IGNORED))
add_dialogues(SDO_BLOCK, BLOCK_DIALOGUES)


# --- expedited and segmented transfer ---


def transfer(command: int, item: ODVariable, data: bytes = b"") -> bytes:
    """Return the request that initiates a transfer of an object."""
    return bytes([command]) + multiplexer(item.index, item.subindex) + data


@SDO.case("expedited-upload", "expedited upload states its size", "CiA 301 7.2.4.3.6")
def expedited_upload(probe: CanopenProbe) -> None:
    for size, command in ((1, 0x4F), (2, 0x4B), (4, 0x43)):
        fitting = [
            item for item in probe.variables() if item.readable and is_integer(item) and size_of(item) == size
        ]
        if not fitting:
            continue
        item = fitting[0]
        probe.expect_answer(
            upload_request(item.index, item.subindex), f"{command:02x} {mux(item)} .. .. .. .."
        )


@SDO.case("segmented-upload", "segmented upload: size, toggle, last segment", "CiA 301 7.2.4.3.7")
def segmented_upload(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    probe.expect_answer(
        upload_request(item.index, item.subindex), f"41 {mux(item)} {len(value).to_bytes(4, 'little').hex()}"
    )
    toggle, data = 0, b""
    while len(data) < len(value):
        left = len(value) - len(data)
        used = min(7, left)
        command = toggle | (7 - used) << 1 | (left <= 7)
        answer = probe.expect_answer(bytes([0x60 | toggle]), f"{command:02x}" + " .." * 7)
        data += answer[1 : 1 + used]
        toggle ^= 0x10
    check_equal(data, value, "value")
    probe.expect_abort("60", Abort.COMMAND)


# --- block transfer ---


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
        frame = probe.expect(SDO_RESPONSE + probe.node, f"segment {len(found) + 1} of the block")
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
    end = probe.expect(SDO_RESPONSE + probe.node, "end of the block upload")
    check(end[0] & 0xE3 == 0xC1, "end C1h to DDh", end)
    unused = end[0] >> 2 & 7
    data = data[: len(data) - unused]
    if total is not None:
        check_equal(len(data), total, "bytes")
    if with_crc:
        check_equal(int.from_bytes(end[1:3], "little"), crc_hqx(data, 0), "CRC")
    probe.send_request(b"\xa1")
    probe.expect_silence(SDO_RESPONSE + probe.node, "answer to the end of an upload", 0.05)
    return data


UPLOADS: Final = (
    ("upload", "block upload with CRC", (127,), True),
    ("upload-sizes", "block upload in blocks of 1, 2 and 5 segments", (1, 2, 5), True),
    ("upload-without-crc", "block upload without CRC", (127,), False),
)
"""ID, title, segments in a block, and whether there is a CRC."""


def _uploaded(sizes: tuple[int, ...], crc: bool, probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    for size in sizes:
        check_equal(upload_blocks(probe, item, size, crc=crc), value, "value")
    check_abort(probe.ask("60"), Abort.COMMAND)


for _name, _title, _sizes, _crc in UPLOADS:
    SDO_BLOCK.case(_name, _title, "CiA 301 7.2.4.3.13")(partial(_uploaded, _sizes, _crc))


@SDO_BLOCK.case("upload-big", "block upload of many blocks", "CiA 301 7.2.4.3.13")
def upload_big(probe: CanopenProbe) -> None:
    """Of the longest readable text or domain of at most 200 kB."""
    best: tuple[int, ODVariable | None] = 0, None
    for item in probe.variables():
        long = (datatypes.DOMAIN, datatypes.VISIBLE_STRING, datatypes.OCTET_STRING)
        if item.readable and item.data_type in long:
            begun = probe.ask(upload_request(item.index, item.subindex))
            probe.abandon_transfer()
            size = int.from_bytes(begun[4:], "little") if begun is not None and begun[0] == 0x41 else 0
            if best[0] < size <= 200_000:
                best = size, item
    if best[1] is None:
        raise CaseSkipped("no readable object of more than 4 bytes")
    if len(upload_blocks(probe, best[1], 100)) <= SEGMENT * 100:
        raise CaseSkipped(f"the longest object, {best[1].qualname}, fits into one block")


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


@SDO_BLOCK.case("threshold", "protocol switch threshold", "CiA 301 7.2.4.3.13")
def threshold(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    answer = _initiate_upload(probe, item, 127, threshold=min(255, len(value)))
    check(answer[0] in {0x41, 0xC6, 0xC4, 0xC2, 0xC0}, "answer 41h or C6h", answer)
    probe.abandon_transfer()
    answer = _initiate_upload(probe, item, 127, threshold=7)
    check(answer[0] & 0xF9 == 0xC0, "answer C6h", answer)
    probe.abandon_transfer()


@SDO_BLOCK.case("download-zero", "segment number 0", intrusive=True)
def download_zero(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    probe.ask(transfer(0xC6, item, b"\x02"))
    answer = probe.ask(b"\x00\x39\x30")
    if answer is not None:
        check_abort(answer, Abort.SEQUENCE, multiplexer=mux(item))
    else:
        probe.abandon_transfer()
    probe.expect_answer("40 00 10 00", "43 00 10 00 .. .. .. ..")
