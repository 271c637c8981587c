"""CANopen conformance: SDO server, expedited and segmented transfer (CiA 301 7.2.4)."""

from __future__ import annotations

from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import (
    STOP,
    Abort,
    CanopenProbe,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check_equal
from starhil.hil_tests.judge.canopen import multiplexer

SDO: Final = CaseArea[CanopenProbe]("canopen.sdo", "CiA 301 7.2.4.3.17")
LONGEST_TIMEOUT_S: Final = 12.0


def long_text(probe: CanopenProbe) -> tuple[ODVariable, bytes]:
    """Return a readable text that takes three segments, or two full ones if there is no longer text."""
    two_segments: tuple[ODVariable, bytes] | None = None
    for item in probe.variables():
        if item.data_type in {datatypes.VISIBLE_STRING, datatypes.OCTET_STRING} and item.readable:
            value = probe.try_read(item.index, item.subindex)
            if isinstance(value, bytes) and len(value) > 14:
                return item, value
            if isinstance(value, bytes) and len(value) == 14 and two_segments is None:
                two_segments = item, value
    if two_segments is None:
        raise CaseSkipped("no readable text of 14 bytes or more")
    return two_segments


def writable_number(probe: CanopenProbe) -> ODVariable:
    """Return a writable 16-bit number without side effects, preferably the heartbeat time."""
    if 0x1017 in probe.od:
        item = probe.od.get_variable(0x1017)
        if item is not None:
            return item
    return probe.find(
        "writable 16-bit number",
        lambda item: item.access_type == "rw" and is_integer(item) and size_of(item) == 2,
    )


def transfer(command: int, item: ODVariable, data: bytes = b"") -> bytes:
    """Return the request that initiates a transfer of an object."""
    return bytes([command]) + multiplexer(item.index, item.subindex) + data


def upload(item: ODVariable) -> bytes:
    """Return the request that initiates an upload of an object."""
    return transfer(0x40, item)


def mux(item: ODVariable) -> str:
    """Return the multiplexer of an object as hexadecimal text."""
    return multiplexer(item.index, item.subindex).hex()


def expect_no_transfer(probe: CanopenProbe) -> None:
    """Fail if a segment request shows that a transfer is active."""
    probe.check_abort(probe.ask("60"), Abort.COMMAND)


@SDO.case("expedited-upload", "expedited upload states its size", "CiA 301 7.2.4.3.6")
def expedited_upload(probe: CanopenProbe) -> None:
    for size, command in ((1, 0x4F), (2, 0x4B), (4, 0x43)):
        fitting = [
            item for item in probe.variables() if item.readable and is_integer(item) and size_of(item) == size
        ]
        if not fitting:
            continue
        item = fitting[0]
        probe.expect_answer(upload(item), f"{command:02x} {mux(item)} .. .. .. ..")


@SDO.case("expedited-download", "expedited download is confirmed", "CiA 301 7.2.4.3.3", intrusive=True)
def expedited_download(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    probe.expect_answer(transfer(0x2B, item, b"\x39\x30"), f"60 {mux(item)} 00000000")
    check_equal(probe.number(item.index, item.subindex), 12345, "value")


@SDO.case("no-size", "expedited download without a size", "CiA 301 7.2.4.3.3", intrusive=True)
def no_size(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    probe.expect_answer(transfer(0x22, item, b"\x39\x30"), f"60 {mux(item)} 00000000")
    check_equal(probe.number(item.index, item.subindex), 12345, "value")


@SDO.case("segmented-upload", "segmented upload: size, toggle, last segment", "CiA 301 7.2.4.3.7")
def segmented_upload(probe: CanopenProbe) -> None:
    item, value = long_text(probe)
    probe.expect_answer(upload(item), f"41 {mux(item)} {len(value).to_bytes(4, 'little').hex()}")
    toggle, data = 0, b""
    while len(data) < len(value):
        left = len(value) - len(data)
        used = min(7, left)
        command = toggle | (7 - used) << 1 | (left <= 7)
        answer = probe.expect_answer(bytes([0x60 | toggle]), f"{command:02x}" + " .." * 7)
        data += answer[1 : 1 + used]
        toggle ^= 0x10
    check_equal(data, value, "value")
    expect_no_transfer(probe)


@SDO.case("upload-toggle", "toggle bit not alternated in an upload")
def upload_toggle(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.check_abort(probe.ask("70"), Abort.TOGGLE, multiplexer=mux(item))
    expect_no_transfer(probe)
    probe.ask(upload(item))
    probe.ask("60")
    probe.check_abort(probe.ask("60"), Abort.TOGGLE, multiplexer=mux(item))
    expect_no_transfer(probe)


@SDO.case("segmented-download", "segmented download of a number", "CiA 301 7.2.4.3.4", intrusive=True)
def segmented_download(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    for command, size, value in ((0x21, 2, b"\x39\x30"), (0x20, 0, b"\x38\x30")):
        request = transfer(command, item, size.to_bytes(4, "little"))
        probe.expect_answer(request, f"60 {mux(item)} 00000000")
        probe.expect_answer(bytes([5 << 1 | 1]) + value, "20 00000000000000")
        check_equal(probe.read(item.index, item.subindex), value, "value")


@SDO.case("download-in-parts", "segmented download in two segments", "CiA 301 7.2.4.3.4", intrusive=True)
def download_in_parts(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    before = probe.read(item.index, item.subindex)
    value = bytes([before[0] ^ 0x55, before[1] ^ 0x01])
    probe.ask(transfer(0x21, item, b"\x02\0\0\0"))
    probe.expect_answer(bytes([6 << 1]) + value[:1], "20 00000000000000")
    probe.expect_answer(bytes([0x10 | 6 << 1 | 1]) + value[1:], "30 00000000000000")
    check_equal(probe.read(item.index, item.subindex), value, "value")


@SDO.case("download-toggle", "toggle bit not alternated in a download", intrusive=True)
def download_toggle(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    before = probe.read(item.index, item.subindex)
    probe.ask(transfer(0x21, item, b"\x02\0\0\0"))
    probe.check_abort(probe.ask(bytes([0x10 | 5 << 1 | 1, 0x11, 0x11])), Abort.TOGGLE, multiplexer=mux(item))
    probe.check_abort(probe.ask("01"), Abort.COMMAND)
    probe.ask(transfer(0x21, item, b"\x02\0\0\0"))
    probe.ask(bytes([6 << 1, 0x11]))
    probe.check_abort(probe.ask(bytes([6 << 1 | 1, 0x11])), Abort.TOGGLE, multiplexer=mux(item))
    check_equal(probe.read(item.index, item.subindex), before, "value as before")


@SDO.case("announced-high", "announced size larger than the object", intrusive=True)
def announced_high(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    answer = probe.ask(transfer(0x21, item, b"\x03\0\0\0"))
    if answer is not None and answer[0] == 0x60:
        answer = probe.ask(bytes([4 << 1 | 1, 1, 1, 1]))
    probe.check_abort(answer, Abort.LENGTH, Abort.LENGTH_HIGH, multiplexer=mux(item))


@SDO.case("sent-high", "more bytes sent than the object has", intrusive=True)
def sent_high(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    probe.ask(transfer(0x20, item))
    answer = probe.ask(bytes([4 << 1 | 1, 1, 1, 1]))
    probe.check_abort(answer, Abort.LENGTH, Abort.LENGTH_HIGH, multiplexer=mux(item))


@SDO.case("sent-low", "fewer bytes sent than the object has", intrusive=True)
def sent_low(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    before = probe.read(item.index, item.subindex)
    probe.ask(transfer(0x20, item))
    answer = probe.ask(bytes([6 << 1 | 1, before[0] ^ 1]))
    probe.check_abort(answer, Abort.LENGTH, Abort.LENGTH_LOW, multiplexer=mux(item))
    check_equal(probe.read(item.index, item.subindex), before, "value as before")


@SDO.case("announced-differs", "fewer bytes sent than announced", intrusive=True)
def announced_differs(probe: CanopenProbe) -> None:
    item = writable_number(probe)
    probe.ask(transfer(0x21, item, b"\x02\0\0\0"))
    answer = probe.ask(bytes([6 << 1 | 1, 1]))
    probe.check_abort(answer, Abort.LENGTH, Abort.LENGTH_HIGH, Abort.LENGTH_LOW, multiplexer=mux(item))


@SDO.case("unknown-command", "unknown command specifier")
def unknown_command(probe: CanopenProbe) -> None:
    probe.check_abort(probe.ask("e0 00 10 00"), Abort.COMMAND)


@SDO.case("no-transfer", "segments without a transfer")
def no_transfer(probe: CanopenProbe) -> None:
    for request in ("60", "70", "00", "01", "a1", "a2 01 7f", "a3", "c1"):
        probe.check_abort(probe.ask(request), Abort.COMMAND)


@SDO.case("wrong-segment", "download segment within an upload")
def wrong_segment(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.check_abort(probe.ask("00"), Abort.COMMAND)
    expect_no_transfer(probe)


@SDO.case("client-abort", "an abort by the client ends the transfer and is not answered")
def client_abort(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.send(0x600 + probe.node, transfer(0x80, item, bytes.fromhex("00000405")))
    probe.expect_silence(0x580 + probe.node, "answer to an abort")
    expect_no_transfer(probe)


@SDO.case("new-request", "a new request replaces the active transfer", "CiA 301 7.2.4.3.6")
def new_request(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.ask("60")
    probe.expect_answer("40 00 10 00", "43 00 10 00 .. .. .. ..")
    expect_no_transfer(probe)


@SDO.case("time-out", "a transfer whose client stops sending times out")
def time_out(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.check_abort(
        probe.wait_for(0x580 + probe.node, LONGEST_TIMEOUT_S), Abort.TIMEOUT, multiplexer=mux(item)
    )
    expect_no_transfer(probe)


@SDO.case("wrong-length", "frames with a length other than 8 bytes are ignored", "CiA 301 7.2.4.3.2")
def wrong_length(probe: CanopenProbe) -> None:
    for length in (0, 4, 7):
        probe.send(0x600 + probe.node, bytes.fromhex("40001000000000")[:length])
        probe.expect_silence(0x580 + probe.node, f"answer to {length} bytes")


@SDO.case("extended", "frames with a 29-bit CAN ID are ignored", "CiA 301 7.3.5")
def extended(probe: CanopenProbe) -> None:
    probe.send(0x600 + probe.node, "40 00 10 00 00 00 00 00", extended=True)
    probe.expect_silence(0x580 + probe.node, "answer to an extended frame")


@SDO.case("remote", "remote frames are ignored", "CiA 301 7.2.4")
def remote(probe: CanopenProbe) -> None:
    probe.send(0x600 + probe.node, remote=True)
    probe.expect_silence(0x580 + probe.node, "answer to a remote frame")


@SDO.case("other-node", "requests to another node are not answered", "CiA 301 7.3.5")
def other_node(probe: CanopenProbe) -> None:
    probe.send(0x600 + (probe.node % 127 + 1), "40 00 10 00 00 00 00 00")
    probe.expect_silence(0x580 + probe.node, "answer to another node's request")


@SDO.case("stopped", "no SDO in STOPPED", "CiA 301 7.3.2.2.5", intrusive=True)
def stopped(probe: CanopenProbe) -> None:
    item, _ = long_text(probe)
    probe.ask(upload(item))
    probe.command(STOP)
    if probe.ask("60", 0.2) is not None or probe.ask("40 00 10 00", 0.2) is not None:
        raise CaseFailed("no SDO answer in STOPPED", "an answer")


@SDO.case("server-parameter", "1200h holds the CAN IDs in use", "CiA 301 7.5.2.33")
def server_parameter(probe: CanopenProbe) -> None:
    probe.require(0x1200)
    check_equal(probe.number(0x1200, 1), 0x600 + probe.node, "1200h:01h")
    check_equal(probe.number(0x1200, 2), 0x580 + probe.node, "1200h:02h")
