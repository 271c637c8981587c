"""Image capture and both ways of download, over the device's own requests."""

import binascii
import struct

import cv2
import numpy as np
import pytest

from starhil.emulator.device.stored_images import StoredImage, msdos_time
from starhil.emulator.sensor.pipeline.messages import Failure, ImageRequest, ImageResult
from starhil.protocol.messages import ErrorCode, ReplyKind, Request


def save(bench, size="size_64"):
    assert bench.command("save_image", image_size=size) is ErrorCode.OK
    bench.step(1.3)
    assert bench.read("image_status") == {"percent": 100, "status": "ok"}


def download(bench, edge, size_name):
    assert bench.command("init_image_download", image_size=size_name) is ErrorCode.OK
    pixels = b""
    for frame in range(edge * edge // 128):
        assert bench.command("advance_image_download", next_frame=frame) is ErrorCode.OK
        data = bench.read("image_frame")["data"]
        assert bench.read("image_frame_info") == {"frame": frame, "checksum": sum(data) % 256}
        pixels += data
    return np.frombuffer(pixels, np.uint8).reshape(edge, edge)


@pytest.mark.parametrize("edge", [64, 128, 256])
def test_an_image_is_captured_in_standby_and_downloaded_by_frames(bench, edge):
    at_s = bench.clock.now_ns() / 1e9
    save(bench, f"size_{edge}")
    image = download(bench, edge, f"size_{edge}")
    assert (image == np.arange(edge, dtype=np.uint8)[np.newaxis] % 251).all()
    exposed = bench.pipeline.frames[-1]
    assert not exposed.solve
    assert exposed.begin_s == pytest.approx(at_s, abs=1e-6)
    assert bench.read("device_status")["image_stored"]


def test_capture_takes_the_next_frame_while_frames_run(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    count = len(bench.pipeline.frames)
    bench.command("save_image", image_size="size_64")
    assert bench.read("image_status")["status"] == "waiting_sensor"
    assert bench.read("image_status")["percent"] == 0
    bench.step(0.61)
    assert bench.read("image_status") == {"percent": 50, "status": "waiting_frame"}
    bench.step(0.1)
    assert bench.read("image_status") == {"percent": 100, "status": "ok"}
    assert bench.device.images.state.stored.frame == bench.pipeline.frames[count].index
    assert all(request.solve for request in bench.pipeline.frames)


def test_only_one_capture_at_a_time(bench):
    bench.command("save_image", image_size="size_64")
    assert bench.command("save_image", image_size="size_64") is ErrorCode.BUSY
    assert bench.command("init_image_download", image_size="size_64") is ErrorCode.BUSY
    bench.step(1.0)
    assert bench.command("save_image", image_size="size_64") is ErrorCode.OK


def test_other_cameras_do_not_exist(bench):
    assert bench.command("save_image", camera="camera_1", image_size="size_64") is ErrorCode.INVALID_PARAMETER


def test_download_needs_an_image_and_its_frames(bench):
    assert bench.command("init_image_download", image_size="size_64") is ErrorCode.SEQUENCE
    assert bench.command("advance_image_download", next_frame=0) is ErrorCode.SEQUENCE
    save(bench, "size_64")
    assert bench.command("init_image_download", image_size="size_128") is ErrorCode.INVALID_PARAMETER
    assert bench.command("init_image_download", image_size="size_64") is ErrorCode.OK
    assert bench.command("advance_image_download", next_frame=31) is ErrorCode.OK
    assert bench.command("advance_image_download", next_frame=32) is ErrorCode.INVALID_PARAMETER
    assert bench.read("image_frame_info")["frame"] == 31


def test_the_image_is_kept_while_another_is_captured(bench):
    save(bench, "size_64")
    bench.command("init_image_download", image_size="size_64")
    bench.command("advance_image_download", next_frame=3)
    before = bench.read("image_frame")["data"]
    first = bench.device.images.state.download
    bench.command("save_image", image_size="size_128")
    bench.step(1.0)
    assert bench.device.images.state.stored.edge == 128
    assert bench.device.images.state.download is first
    assert bench.read("image_frame")["data"] == before


def test_the_last_frame_can_be_downloaded_without_a_capture(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    assert bench.command("init_image_download", sram=1, image_size="size_64") is ErrorCode.OK
    assert not bench.read("acknowledge")["processed"]
    row = bench.icd.telemetry["image_frame"]
    assert bench.requests.handle(Request.of(row.id))[0].code is ErrorCode.BUSY
    bench.step(0.2)
    assert bench.read("acknowledge")["processed"]
    assert bench.device.images.state.download.frame == bench.pipeline.frames[-1].index
    assert len(bench.read("image_frame")["data"]) == 128


def test_without_any_frame_there_is_no_last_one(bench):
    bench.command("init_image_download", sram=1, image_size="size_64")
    bench.step(0.2)
    assert bench.read("acknowledge")["error"] == "sequence"


def test_a_smaller_size_is_the_mean_over_squares():
    pixels = np.random.default_rng(1).integers(0, 256, (128, 128), dtype=np.uint8)
    small = StoredImage(128, pixels.tobytes(), 0, 1).binned(64)
    expected = cv2.resize(pixels.astype(np.float64), (64, 64), interpolation=cv2.INTER_AREA)
    got = np.frombuffer(small.pixels, np.uint8).reshape(64, 64)
    assert np.abs(got - expected).max() <= 0.5


def test_a_new_frame_is_taken_beside_the_stored_image(bench):
    save(bench, "size_64")
    taken = []
    bench.device.images.capture_full().when_done(taken.append)
    assert bench.command("save_image", image_size="size_64") is ErrorCode.BUSY
    bench.step(1.0)
    (frame,) = taken
    assert (frame.width, frame.height, len(frame.pixels)) == (10, 10, 100)
    assert frame.frame == bench.pipeline.frames[-1].index
    assert bench.device.images.state.stored.edge == 64
    assert bench.command("save_image", image_size="size_64") is ErrorCode.OK


@pytest.mark.parametrize("stop", ["command", "sensor"])
def test_a_capture_is_done_though_frames_stop_before_the_next_one(bench, stop):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    count = len(bench.pipeline.frames)
    bench.command("save_image", image_size="size_64")
    bench.step(0.55)  # in the middle of an exposure
    if stop == "command":
        bench.command("set_mode", mode="standby")
    else:
        bench.device.modes.fail("sensor")
    bench.step(0.25)  # exposed again, and stored
    assert bench.read("image_status") == {"percent": 100, "status": "ok"}
    (frame,) = bench.pipeline.frames[count:]
    assert not frame.solve
    assert bench.device.images.state.stored.frame == frame.index
    assert not bench.device.images.state.busy


def test_a_whole_frame_is_taken_though_frames_stop(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    taken = []
    bench.device.images.capture_full().when_done(taken.append)
    bench.command("set_mode", mode="standby")
    bench.step(0.25)
    assert [frame.frame for frame in taken] == [bench.pipeline.frames[-1].index]


def test_a_capture_ends_when_the_pipeline_is_lost(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    bench.command("save_image", image_size="size_64")
    bench.imager._handle = lambda _request: Failure("gone")
    bench.device.pipeline_lost()
    bench.step(0.25)
    assert bench.read("image_status") == {"percent": 0, "status": "storage_error"}
    assert not bench.device.images.state.busy


def test_a_capture_does_not_outlive_a_reset(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    count = len(bench.pipeline.requests)
    bench.command("save_image", image_size="size_64")
    bench.command("reset")
    bench.step(5.0)
    assert len(bench.pipeline.requests) == count
    assert not bench.device.images.state.busy


def test_a_reset_forgets_images(bench):
    for number in (1, 2):
        save(bench)
        assert bench.device.images.state.stored.number == number
    bench.command("reset")
    bench.step(1.0)
    assert not bench.read("device_status")["image_stored"]
    save(bench)
    assert bench.device.images.state.stored.number == 1


# --- files in bursts ---


def load(bench, file_type, offset, length, counter=0):
    return bench.command(
        "load_file_block", file_type=file_type, file_counter=counter, offset=offset, length=length
    )


def test_the_image_comes_as_a_bmp_file_by_bursts_with_holes(bench):
    save(bench, "size_64")
    assert load(bench, "index", 0, 12) is ErrorCode.OK
    index = bench.device.files.state.block
    kind, number, edge, size, _frame = struct.unpack("<BBHII", index)
    assert (kind, edge) == (4, 64)
    file = b""
    while len(file) < size:
        length = min(2000, size - len(file))
        assert load(bench, "bmp", len(file), length, number) is ErrorCode.OK
        block = bench.read("file_block")
        assert (block["ready"], block["length"]) == (True, length)
        packets = bench.send("start_burst", ignore_hole_map=True)[1:]
        assert {(p.kind, p.id, len(p.data)) for p in packets} == {(ReplyKind.BURST, 119, 22)}
        parts = dict(struct.unpack("<H20s", p.data) for p in packets)
        data = b"".join(parts[n] for n in range(len(parts)))[:length]
        assert binascii.crc_hqx(data, 0) == block["checksum"]
        file += data
    image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (64, 64)
    assert (image == np.arange(64, dtype=np.uint8)[np.newaxis]).all()


def test_a_burst_sends_only_what_the_hole_map_lacks(bench):
    save(bench, "size_64")
    load(bench, "bmp", 0, 4000)
    arrived = bytearray(16)
    for number in (0, 5, 127):
        arrived[number // 8] |= 1 << number % 8
    bench.command("set_hole_map_1", map=bytes(arrived))
    bench.command("set_hole_map_2", map=b"\xff" * 16)
    assert bench.read("hole_map_2")["map"] == b"\xff" * 16
    numbers = [struct.unpack_from("<H", p.data)[0] for p in bench.send("start_burst")[1:]]
    assert numbers == [n for n in range(128) if n not in {0, 5, 127}]


@pytest.mark.parametrize(
    ("file_type", "offset", "length"),
    [("jpg", 0, 10), ("telemetry", 0, 10), ("bmp", 5174, 200), ("index", 12, 1), ("bmp", 0, 0)],
)
def test_files_that_are_not_there_are_refused(bench, file_type, offset, length):
    save(bench, "size_64")
    assert load(bench, file_type, offset, length) is ErrorCode.INVALID_PARAMETER
    assert bench.read("file_block") == {"ready": False, "parameter_error": True, "checksum": 0, "length": 0}
    assert bench.command("start_burst") is ErrorCode.SEQUENCE
    bench.device.power_on()
    assert not bench.device.files.state.parameter_error


@pytest.mark.parametrize(
    ("offset", "length", "loaded"), [(5100, 200, 74), (0, 20480, 5174), (0, 1024, 5174), (1, 1023, 1023)]
)
def test_a_block_ends_with_its_file(bench, offset, length, loaded):
    save(bench, "size_64")
    assert load(bench, "bmp", offset, length) is ErrorCode.OK
    block = bench.read("file_block")
    assert (block["ready"], block["parameter_error"], block["length"]) == (True, False, loaded)
    assert len(bench.send("start_burst", ignore_hole_map=True)) == 1 + -(-loaded // 20)


def counters(bench):
    assert bench.command("reset_file_list") is ErrorCode.OK
    names = []
    while True:
        assert bench.read("file_info") == dict.fromkeys(bench.icd.telemetry["file_info"].named_fields, 0) | {
            "updating": True
        }
        bench.step(0.03)
        info = bench.read("file_info")
        if not info["type"]:
            return names
        names.append(info["counter"])
        assert bench.command("advance_file_list") is ErrorCode.OK


def test_the_oldest_file_gives_way_and_numbers_begin_again_at_1(bench):
    for _ in range(17):
        save(bench)
    assert counters(bench) == list(range(2, 18))
    bench.device.images._counts["bmp"] = 254
    for _ in range(2):
        save(bench)
    assert counters(bench)[-2:] == [255, 1]


def test_the_file_list_has_size_checksum_and_time(bench):
    bench.command("set_unix_time", seconds=1_900_000_001, milliseconds=0)
    save(bench, "size_128")
    bench.command("reset_file_list")
    bench.step(0.03)
    info = bench.read("file_info")
    file = bench.device.images.state.stored.content()
    assert (info["type"], info["counter"], info["size"]) == (4, 1, len(file))
    assert info["crc"] == binascii.crc_hqx(file, 0)
    date = info["time"] >> 16
    assert ((date >> 9) + 1980, date >> 5 & 15, date & 31) == (2030, 3, 17)
    assert (
        abs(
            (info["time"] >> 11 & 31) * 3600 + (info["time"] >> 5 & 63) * 60 + (info["time"] & 31) * 2 - 64001
        )
        <= 4
    )


def test_an_image_is_converted_to_a_jpg_file(bench):
    save(bench, "size_256")
    nothing = {"percent": 0, "result": "nothing", "file_counter": 0}
    assert bench.read("jpg_status") == nothing
    assert bench.command("convert_to_jpg", file_counter=1, quality=100) is ErrorCode.OK
    assert bench.read("jpg_status") == nothing | {"result": "busy"}
    assert bench.command("convert_to_jpg", file_counter=1) is ErrorCode.BUSY
    bench.step(0.6)
    assert bench.read("jpg_status") == {"percent": 100, "result": "success", "file_counter": 1}
    for counter in (1, 0):  # 0: the newest
        assert load(bench, "jpg", 0, 20480, counter) is ErrorCode.OK
    block = bench.read("file_block")
    file = bench.device.images.file("jpg", 1).content()
    assert (block["length"], block["checksum"]) == (len(file), binascii.crc_hqx(file, 0))
    image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 256)
    assert np.abs(image.astype(int) - np.arange(256) % 251).max() <= 12  # the edge from 250 to 0 rings


def test_files_of_both_kinds_have_numbers_of_their_own(bench):
    for _ in range(2):
        save(bench)
    bench.command("convert_to_jpg", file_counter=2)
    bench.step(0.6)
    assert counters(bench) == [1, 2, 1]
    assert bench.command("erase_file", file_type="bmp", file_counter=1) is ErrorCode.OK
    assert counters(bench) == [2, 1]
    assert bench.command("erase_file", file_type="jpg", file_counter=1) is ErrorCode.OK
    assert counters(bench) == [2]
    assert bench.command("erase_file", file_type="jpg", file_counter=2) is ErrorCode.INVALID_PARAMETER


def test_a_conversion_that_fails_is_a_load_error(bench, monkeypatch):
    failed = {"percent": 0, "result": "load_error", "file_counter": 0}
    assert bench.command("convert_to_jpg", file_counter=7) is ErrorCode.OK
    assert bench.read("jpg_status") == failed
    save(bench)
    monkeypatch.setattr(bench.imager, "submit", lambda _request, done: done(Failure("x")), raising=False)
    assert bench.command("convert_to_jpg", file_counter=1) is ErrorCode.OK
    bench.step(0.6)
    assert bench.read("jpg_status") == failed
    assert counters(bench) == [1]


def test_a_reset_ends_a_conversion(bench):
    save(bench)
    bench.command("convert_to_jpg", file_counter=1)
    bench.command("reset")
    bench.step(3.0)
    assert bench.read("jpg_status")["result"] == "nothing"
    assert counters(bench) == []


@pytest.mark.parametrize(
    ("unix_s", "expected"), [(0, 0x00210000), (315532800 + 2, 0x00210001), (2**33, 0xFF9FBF7D)]
)
def test_times_outside_of_the_ms_dos_format_are_its_limits(unix_s, expected):
    assert msdos_time(unix_s * 10**9) == expected


def test_erasing_all_files_takes_its_time_and_keeps_an_open_download(bench):
    save(bench)
    bench.command("init_image_download", image_size="size_64")
    before = bench.read("image_frame")
    for name, values, flags in (
        ("erase_file", {"all": True}, {"formatting": False, "erasing": True}),
        ("format_card", {}, {"formatting": True, "erasing": False}),
    ):
        assert bench.command(name, **values) is ErrorCode.OK
        assert bench.read("card_progress") == flags
        bench.step(0.2)
        assert bench.read("card_progress") == {"formatting": False, "erasing": False}
    assert counters(bench) == []
    assert not bench.read("device_status")["image_stored"]
    assert bench.read("image_frame") == before


def test_packets_of_a_burst_are_read_one_by_one(bench):
    save(bench)
    load(bench, "bmp", 0, 60)
    assert bench.read("file_packet")["number"] == 0
    bench.send("start_burst", ignore_hole_map=True)
    bench.read("file_block")
    file = bench.device.images.state.stored.content()
    for number in (0, 1, 2, 2):
        assert bench.read("file_packet") == {"number": number, "data": file[20 * number : 20 * number + 20]}
    bench.command("set_hole_map_1", map=bytes((0b101,)) + bytes(15))
    bench.send("start_burst")
    assert bench.read("file_packet")["number"] == 1


@pytest.fixture
def held_requests(bench, monkeypatch):
    """Hold back what the pipeline is asked from now on; return the requests, each with its callback."""
    requests = []
    monkeypatch.setattr(
        bench.imager, "submit", lambda request, done: requests.append((request, done)), raising=False
    )
    return requests


def images(requests):
    """Let the pipeline answer the requests for images."""
    for request, done in requests:
        if isinstance(request, ImageRequest):
            done(ImageResult(request.edge, request.edge, 7, bytes(request.edge**2)))


def test_an_image_that_the_pipeline_delivers_late_is_stored_when_it_comes(bench, held_requests):
    assert bench.command("save_image", image_size="size_64") is ErrorCode.OK
    bench.step(5.0)
    assert bench.read("image_status")["status"] != "ok"
    images(held_requests)
    assert bench.read("image_status") == {"percent": 100, "status": "ok"}
    assert bench.device.images.state.stored.frame == 7


@pytest.mark.parametrize("wait_s", [0.05, 0.7, 5.0])
def test_a_reset_ends_a_capture_and_what_comes_of_it_later_is_dropped(bench, held_requests, wait_s):
    bench.command("save_image", image_size="size_64")
    bench.step(wait_s)
    bench.device.reset("watchdog")
    bench.step(5.0)
    images(held_requests)
    bench.step(5.0)
    assert bench.device.images.state.stored is None
    assert not bench.device.images.state.busy


def test_no_chunk_is_loaded_while_the_image_is_being_opened(bench, held_requests):
    bench.command("set_mode", mode="lost_in_space")
    open_last = bench.device.images.open_last(64)
    assert bench.command("advance_image_download", next_frame=0) is ErrorCode.BUSY
    bench.step(5.0)
    images(held_requests)
    assert bench.command("advance_image_download", next_frame=0) is ErrorCode.OK
    assert open_last.done
