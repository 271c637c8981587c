"""Conformance of image and file download, on any link."""

from __future__ import annotations

from binascii import crc_hqx
from typing import Final

from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, check, check_equal
from starhil.hil_tests.conformance.link_probe import INVALID_PARAMETER, SEQUENCE, LinkProbe
from starhil.hil_tests.images import bmp_file_size, decode_bmp
from starhil.protocol.values import Value

EDGE: Final = 64
FRAME: Final = 128
PACKET: Final = 20
CRC_START: Final = 0xFFFF
"""Initial value of CRC-16/CCITT-FALSE."""

IMAGES: Final = CaseArea[LinkProbe](
    "images", "CubeSense node TC 64, 65 and TLM 64, 65 (RADSAT-SK)", intrusive=True
)
BURSTS: Final = CaseArea[LinkProbe](
    "bursts", "CubeComputer TC 112, 119 to 127 and TLM 242 (AlbertaSat, CTS)", intrusive=True
)


def _save(probe: LinkProbe) -> None:
    """Store an image of 64 x 64 pixels."""
    probe.standby()
    probe.command("save_image", camera="star", image_size="size_64")
    probe.wait_for("image_status", {"percent": 100, "status": "ok"}, probe.times.image_s)


@IMAGES.case("none", "without a stored image a download is refused with code 7")
def no_image(probe: LinkProbe) -> None:
    probe.reset()
    for name, values in (("init_image_download", {"image_size": "size_64"}), ("advance_image_download", {"next_frame": 0}), ("start_burst", {})):  # fmt: skip
        probe.expect_refused(name, SEQUENCE, **values)


@IMAGES.case("other-camera", "only the star camera exists", "CubeComputer TC 80, TLM 233 (AlbertaSat, CTS)")
def other_camera(probe: LinkProbe) -> None:
    for camera in ("camera_1", "camera_2"):
        probe.expect_refused("save_image", INVALID_PARAMETER, camera=camera, image_size="size_64")


@IMAGES.case("frames", "an image is sent in frames of 128 bytes, each with number and checksum")
def frames(probe: LinkProbe) -> None:
    _save(probe)
    probe.command("init_image_download", image_size="size_64")
    for number in range(EDGE * EDGE // FRAME):
        if number:
            probe.command("advance_image_download", next_frame=number)
        data = probe.telemetry("image_frame")["data"]
        info = probe.telemetry("image_frame_info")
        check_equal(info["frame"], number, "number of the frame")
        check(isinstance(data, bytes), "bytes", type(data))
        check_equal(info["checksum"], sum(bytes(data)) % 256 if isinstance(data, bytes) else -1, "checksum")
        check_equal(probe.telemetry("image_frame")["data"], data, "the same frame")


@IMAGES.case("beyond", "a frame beyond the last is refused with code 3")
def beyond(probe: LinkProbe) -> None:
    _save(probe)
    probe.command("init_image_download", image_size="size_64")
    probe.command("advance_image_download", next_frame=31)
    probe.expect_refused("advance_image_download", INVALID_PARAMETER, next_frame=32)
    check_equal(probe.telemetry("image_frame_info")["frame"], 31, "loaded frame")


@IMAGES.case("jump", "frames may be requested in any order and repeatedly")
def jump(probe: LinkProbe) -> None:
    _save(probe)
    probe.command("init_image_download", image_size="size_64")
    first = probe.telemetry("image_frame")["data"]
    for number in (17, 3, 0):
        probe.command("advance_image_download", next_frame=number)
        check_equal(probe.telemetry("image_frame_info")["frame"], number, "loaded frame")
    check_equal(probe.telemetry("image_frame")["data"], first, "frame 0 as before")


def _load(probe: LinkProbe, offset: int, length: int) -> None:
    probe.command("load_file_block", file_type="bmp", file_counter=0, offset=offset, length=length)
    seen = probe.wait_for("file_block", {"ready": True}, probe.times.image_s)
    check_equal(seen["length"], length, "length of the block")


def _burst(probe: LinkProbe, count: int, *, everything: bool) -> list[tuple[int, bytes]]:
    probe.command("start_burst", ignore_hole_map=everything)
    packets: list[tuple[int, bytes]] = []
    for _ in range(count):
        answer = probe.next_answer()
        if answer.kind != "burst" or len(answer.data) != PACKET + 2:
            raise CaseFailed(f"{count} packets of 22 bytes", f"{len(packets)} of them, then {answer}")
        packets.append((int.from_bytes(answer.data[:2], "little"), answer.data[2:]))
    probe.expect_silence("all packets have arrived")
    return packets


@BURSTS.case("block", "a block is sent in numbered packets of 20 bytes with the right checksum")
def block(probe: LinkProbe) -> None:
    _save(probe)
    _load(probe, 0, 990)
    wanted = probe.telemetry("file_block")["checksum"]
    packets = _burst(probe, 50, everything=True)
    check_equal([number for number, _ in packets], list(range(50)), "numbers")
    data = b"".join(part for _, part in packets)
    check_equal(crc_hqx(data[:990], CRC_START), wanted, "checksum")
    check(bmp_file_size(data) > EDGE * EDGE, "a file larger than its pixels", bmp_file_size(data))


@BURSTS.case("holes", "with a hole map, only missing packets are sent")
def holes(probe: LinkProbe) -> None:
    _save(probe)
    _load(probe, 0, 1000)
    whole = dict(_burst(probe, 50, everything=True))
    arrived = sum(1 << number for number in range(50) if number not in (0, 7, 49))
    probe.command("set_hole_map_1", map=arrived.to_bytes(16, "little"))
    again = dict(_burst(probe, 3, everything=False))
    check_equal(sorted(again), [0, 7, 49], "numbers")
    check_equal(again, {number: whole[number] for number in (0, 7, 49)}, "the same packets")


@BURSTS.case("file", "the whole file is an image of the requested size")
def whole_file(probe: LinkProbe) -> None:
    _save(probe)
    _load(probe, 0, 54)
    size = bmp_file_size(b"".join(part for _, part in _burst(probe, 3, everything=True)))
    _load(probe, 0, size)
    data = b"".join(part for _, part in _burst(probe, -(-size // PACKET), everything=True))[:size]
    _pixels, width, height = decode_bmp(data)
    check_equal((width, height), (EDGE, EDGE), "width and height")


@BURSTS.case("range", "a block outside the file is refused with code 3 and flagged")
def out_of_range(probe: LinkProbe) -> None:
    _save(probe)
    block: dict[str, Value] = {"file_type": "bmp", "file_counter": 0, "offset": 1 << 24, "length": 100}
    probe.expect_refused("load_file_block", INVALID_PARAMETER, **block)
    seen = probe.telemetry("file_block")
    check_equal((seen["ready"], seen["parameter_error"]), (False, True), "ready, parameter_error")
    probe.expect_refused("start_burst", SEQUENCE)
