"""CubeStar's own cases of image and file download, on any link."""

from __future__ import annotations

from binascii import crc_hqx
from typing import Final

from starhil.configs.units.cubestar.controls import reset, standby
from starhil.hil_tests.client.images import decode_bmp
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, check, check_equal
from starhil.hil_tests.conformance.link_probe import INVALID_PARAMETER, SEQUENCE, LinkProbe
from starhil.hil_tests.judge.messages import Value

EDGE: Final = 64
FRAME: Final = 128
PACKET: Final = 20
BLOCK: Final = 20480
CRC_START: Final = 0
"""Initial value of CRC-16/XMODEM."""
MAX_FILES: Final = 300

IMAGES: Final = CaseArea[LinkProbe](
    "images", "CubeSense node TC 64, 65 and TLM 64, 65 (RADSAT-SK)", intrusive=True
)
BURSTS: Final = CaseArea[LinkProbe](
    "bursts", "CubeComputer TC 112, 119 to 127 and TLM 241, 242 (AlbertaSat, CTS, EnduroSat)", intrusive=True
)
JPG: Final = CaseArea[LinkProbe]("jpg", "CubeComputer TC 57 and TLM 133 (AlbertaSat, CTS)", intrusive=True)
FILES: Final = CaseArea[LinkProbe](
    "files", "CubeComputer TC 33, 108, 113, 118 and TLM 234, 243 (AlbertaSat, CTS, EnduroSat)", intrusive=True
)


def _save(probe: LinkProbe) -> None:
    """Store an image of 64 x 64 pixels."""
    standby(probe)
    probe.command("save_image", camera="star", image_size="size_64")
    probe.wait_for("image_status", {"percent": 100, "status": "ok"}, probe.times.image_s)


@IMAGES.case("none", "without a stored image a download is refused with code 7")
def no_image(probe: LinkProbe) -> None:
    reset(probe)
    probe.expect_refused("init_image_download", SEQUENCE, image_size="size_64")
    probe.expect_refused("advance_image_download", SEQUENCE, next_frame=0)
    probe.expect_refused("start_burst", SEQUENCE)


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
    checksum = probe.telemetry("file_block")["checksum"]
    packets = _burst(probe, 50, everything=True)
    check_equal([number for number, _ in packets], list(range(50)), "numbers")
    data = b"".join(part for _, part in packets)
    check_equal(crc_hqx(data[:990], CRC_START), checksum, "checksum")


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


@BURSTS.case("file", "a block ends with the file, which is an image of the requested size")
def whole_file(probe: LinkProbe) -> None:
    _save(probe)
    file = _files(probe)[-1]
    size = int(file["size"])
    for length in (BLOCK, BLOCK // PACKET):  # in bytes, and in packets
        probe.command("load_file_block", file_type="bmp", file_counter=file["counter"], length=length)
        seen = probe.wait_for("file_block", {"ready": True}, probe.times.image_s)
        check_equal(seen["length"], size, "length of the block")
    data = b"".join(part for _, part in _burst(probe, -(-size // PACKET), everything=True))[:size]
    check_equal(crc_hqx(data, CRC_START), file["crc"], "checksum of the file")
    _pixels, width, height = decode_bmp(data)
    check_equal((width, height), (EDGE, EDGE), "width and height")


def _convert(probe: LinkProbe, number: Value, quality: int = 90, result: str = "success") -> dict[str, Value]:
    """Convert an image; return the status with this result."""
    probe.command("convert_to_jpg", file_counter=number, quality=quality)
    return probe.wait_for("jpg_status", {"result": result}, probe.times.image_s)


@JPG.case("converted", "an image is converted to a JPG file of its size, which is listed and downloaded")
def converted(probe: LinkProbe) -> None:
    _save(probe)
    image = _files(probe)[-1]
    status = _convert(probe, image["counter"])
    check_equal(status["percent"], 100, "percent")
    *_, listed_image, file = _files(probe)
    check_equal(listed_image, image, "the image in the list")
    check_equal((file["type"], file["counter"]), (3, status["file_counter"]), "type, counter")
    size = int(file["size"])
    probe.command("load_file_block", file_type="jpg", file_counter=file["counter"], length=BLOCK)
    seen = probe.wait_for("file_block", {"ready": True}, probe.times.image_s)
    check_equal((seen["length"], seen["checksum"]), (size, file["crc"]), "length, checksum of the block")
    data = b"".join(part for _, part in _burst(probe, -(-size // PACKET), everything=True))[:size]
    check_equal((data[:3], data[-2:]), (b"\xff\xd8\xff", b"\xff\xd9"), "start and end of a JPEG image")
    frame = data.index(b"\xff\xc0") if b"\xff\xc0" in data else -9
    edges = (data[frame + 5 : frame + 7], data[frame + 7 : frame + 9])
    check_equal(edges, 2 * (EDGE.to_bytes(2, "big"),), "height and width")


@JPG.case("quality", "less quality makes a smaller file; none outside 1 to 100 is accepted")
def quality(probe: LinkProbe) -> None:
    _save(probe)
    number = _files(probe)[-1]["counter"]
    sizes = []
    for percent in (100, 1):
        _convert(probe, number, percent)
        sizes.append(int(_files(probe)[-1]["size"]))
    check(sizes[1] < sizes[0], "a smaller file", sizes)
    for percent in (0, 101):
        probe.expect_refused("convert_to_jpg", INVALID_PARAMETER, file_counter=number, quality=percent)


@JPG.case("missing", "the conversion of an image that does not exist ends with a load error")
def missing(probe: LinkProbe) -> None:
    for _ in range(2):
        _save(probe)
    number = _files(probe)[-2]["counter"]
    probe.command("erase_file", file_type="bmp", file_counter=number)
    before = _files(probe)
    _convert(probe, number, result="load_error")
    check_equal(_files(probe), before, "list of files")


@BURSTS.case("one-by-one", "the packets of a burst can be read one by one, and the last one stays")
def one_by_one(probe: LinkProbe) -> None:
    _save(probe)
    _load(probe, 0, 990)
    sent = _burst(probe, 50, everything=True)
    row = probe.unit.telemetry["file_packet"]
    for number, data in (*sent, sent[-1]):
        check_equal(probe.data_of(row), number.to_bytes(2, "little") + data, f"packet {number}")


def _files(probe: LinkProbe) -> list[dict[str, Value]]:
    probe.command("reset_file_list")
    files: list[dict[str, Value]] = []
    while len(files) < MAX_FILES:
        info = probe.wait_for("file_info", {"updating": False}, probe.times.image_s)
        if not any(info.values()):
            return files
        files.append(info)
        probe.command("advance_file_list")
    raise CaseFailed("an end of the list of files", f"{MAX_FILES} files")


@FILES.case("list", "a saved image is a new file at the end of the list, and the list can be read again")
def listed(probe: LinkProbe) -> None:
    _save(probe)
    before = _files(probe)
    _save(probe)
    after = _files(probe)
    check(after[-1] not in before, "a new last file", after[-1])
    check_equal((after[-1]["type"], after[-1]["updating"]), (4, False), "type and updating")
    check(int(after[-1]["size"]) > EDGE * EDGE, "a file larger than its pixels", after[-1]["size"])
    check_equal(_files(probe), after, "the same list")


@FILES.case("end", "beyond the end of the list, the information stays zero")
def end_of_list(probe: LinkProbe) -> None:
    _save(probe)
    _files(probe)
    for _ in range(3):
        probe.command("advance_file_list")
        seen = probe.wait_for("file_info", {"updating": False}, probe.times.image_s)
        check(not any(seen.values()), "zeros", seen)


@FILES.case("erase", "an erased file is no longer in the list and cannot be loaded")
def erased(probe: LinkProbe) -> None:
    for _ in range(2):
        _save(probe)
    files = _files(probe)
    gone = files[-2]["counter"]
    probe.command("erase_file", file_type="bmp", file_counter=gone)
    check_equal(_files(probe), [*files[:-2], files[-1]], "list of files")
    probe.expect_refused("erase_file", INVALID_PARAMETER, file_type="bmp", file_counter=gone)
    probe.expect_refused(
        "load_file_block", INVALID_PARAMETER, file_type="bmp", file_counter=gone, length=BLOCK
    )


@FILES.case("erase-all", "all files can be erased, by either telecommand")
def erased_all(probe: LinkProbe) -> None:
    for name, values in (("erase_file", {"all": True}), ("format_card", {})):
        _save(probe)
        probe.command(name, **values)
        probe.wait_for("card_progress", {"formatting": False, "erasing": False}, probe.times.image_s)
        check_equal(_files(probe), [], "list of files")
        check(not probe.telemetry("device_status")["image_stored"], "no stored image", "one")


@BURSTS.case("range", "a block outside the file is refused with code 3 and flagged")
def out_of_range(probe: LinkProbe) -> None:
    _save(probe)
    block: dict[str, Value] = {"file_type": "bmp", "file_counter": 0, "offset": 1 << 24, "length": 100}
    probe.expect_refused("load_file_block", INVALID_PARAMETER, **block)
    seen = probe.telemetry("file_block")
    check_equal((seen["ready"], seen["parameter_error"]), (False, True), "ready, parameter_error")
    probe.expect_refused("start_burst", SEQUENCE)
