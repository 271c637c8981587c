"""Files that the bench writes and reads: images, wire logs, JUnit, truth."""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest

from starhil.hil_tests.attitude import attitude_error, from_radec_roll
from starhil.hil_tests.client.images import decode_bmp, write_png
from starhil.hil_tests.client.raw_traffic import matches, parse_frame, pattern
from starhil.hil_tests.client.wire_log import WireLog
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.reports import FAILED, PASSED, SKIPPED, TestCase, write_junit
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.timing.figures import percentile
from starhil.protocol.can.frame import CanFrame, bus_name
from tests.candump import read_candump


def random_image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width), dtype=np.uint8)


def test_an_image_is_read_back_by_opencv_pixel_for_pixel(tmp_path):
    image = random_image(37, 64)
    write_png(tmp_path / "a.png", image.tobytes(), 64, 37)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED), image)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_an_image_of_another_size_is_rejected(tmp_path):
    with pytest.raises(BenchError, match="4096 bytes, not 10"):
        write_png(tmp_path / "a.png", bytes(10), 64, 64)


@pytest.mark.parametrize("width", [64, 61])
def test_a_bmp_file_is_read_as_opencv_wrote_it(width):
    image = random_image(40, width)
    ok, data = cv2.imencode(".bmp", image)
    assert ok
    assert decode_bmp(data.tobytes()) == (image.tobytes(), width, 40)


@pytest.mark.parametrize("data", [b"", b"BM", b"PNG" * 50, b"BM" + bytes(100)])
def test_a_file_that_is_not_a_bmp_is_rejected(data):
    with pytest.raises(BenchError):
        decode_bmp(data)


def test_the_serial_log_shows_time_direction_and_bytes(tmp_path):
    with WireLog(tmp_path / "serial.log", now=lambda: 1760000000.5) as log:
        log.sent(bytes.fromhex("1F7F801FFF"))
        log.note("step 1")
        log.received(b"\x1f\x7f")
    log.received(b"late")
    assert (tmp_path / "serial.log").read_text().splitlines()[1:] == [
        "(1760000000.500000) TX 1F 7F 80 1F FF",
        "# (1760000000.500000) step 1",
        "(1760000000.500000) RX 1F 7F",
    ]


def test_the_can_log_is_read_back_as_candump_lines(tmp_path):
    frames = [
        CanFrame(0x04850104),
        CanFrame(0x05850401, b"\x01\x02"),
        CanFrame(0x123, b"\xff", extended=False),
    ]
    with WireLog(tmp_path / "can.log", bus_name("socketcand:127.0.0.1:29536/can7"), now=lambda: 12.25) as log:
        log.note("not in this format")
        for frame in frames:
            log.sent(frame)
    lines = list(read_candump(tmp_path / "can.log"))
    assert [(channel, frame.id, frame.data, frame.extended) for channel, frame in lines] == [
        ("can7", frame.id, frame.data, frame.extended) for frame in frames
    ]
    assert {frame.timestamp for _, frame in lines} == {12.25}


def test_the_junit_file_has_counts_and_failure_messages(tmp_path):
    cases = [
        TestCase("s", "one", PASSED, "fine", 0.5, "x = 1"),
        TestCase("s", "two\x00", FAILED, "bytes \x01 <wrong>", 0.25),
        TestCase("s", "three", SKIPPED, "not now", 0.0),
    ]
    write_junit(tmp_path / "j.xml", "suite", cases, 0.75)
    suite = ET.parse(tmp_path / "j.xml").getroot().find("testsuite")
    assert {key: suite.get(key) for key in ("tests", "failures", "errors", "skipped")} == {
        "tests": "3", "failures": "1", "errors": "0", "skipped": "1",
    }  # fmt: skip
    assert suite.find("testcase/failure").get("message") == "bytes \ufffd <wrong>"
    assert suite.find("testcase/system-out").text == "x = 1"


def test_the_truth_lies_between_the_rows_of_the_file_while_it_grows(tmp_path):
    path = tmp_path / "truth.csv"
    head = "frame,time_of_exposure_s,true_qx,true_qy,true_qz,true_qw\n"
    rows = [
        f"{n},{100 + n}," + ",".join(repr(v) for v in from_radec_roll(10.0 + n, 0.0, 0.0)) + "\n"
        for n in range(3)
    ]
    path.write_text(head + rows[0] + rows[1])
    truth = TruthLogReader(path)
    assert attitude_error(truth.at(100.5), from_radec_roll(10.5, 0.0, 0.0)).total_arcsec < 1e-3
    with pytest.raises(BenchError, match=r"102\.000 s; it covers 100\.000 to 101\.000"):
        truth.at(102.0)
    path.write_text(head + "".join(rows) + "3,103,0.1")
    assert attitude_error(truth.at(102.0), from_radec_roll(12.0, 0.0, 0.0)).total_arcsec < 1e-3
    assert attitude_error(truth.latest(), from_radec_roll(12.0, 0.0, 0.0)).total_arcsec < 1e-3
    path.write_text(head + "".join(rows[::-1]))  # the clock was set back
    assert attitude_error(truth.latest(), from_radec_roll(10.0, 0.0, 0.0)).total_arcsec < 1e-3
    path.write_bytes(head.encode() + b"\xff\n")
    with pytest.raises(BenchError, match="cannot be read: not UTF-8"):
        TruthLogReader(path).at(1.0)
    path.write_text(head)
    with pytest.raises(BenchError, match="it covers nothing"):
        TruthLogReader(path).at(1.0)
    TruthLogReader(path).check()
    with pytest.raises(BenchError, match="has no truth yet"):
        TruthLogReader(path).latest()
    path.write_text("time,qx\n")
    with pytest.raises(BenchError, match="no column time_of_exposure_s"):
        TruthLogReader(path).at(1.0)
    with pytest.raises(BenchError, match="cannot be read"):
        TruthLogReader(tmp_path / "none.csv").at(1.0)


@pytest.mark.parametrize("text", ["07360104#0001020304050601", "02360401#", "123#R", "7FF#00"])
def test_frames_are_written_as_they_are_read(text):
    assert str(parse_frame(text)) == text


@pytest.mark.parametrize(
    "text",
    ["", "07360104", "#00", "12#00", "123#0", "123#000102030405060708", "123#00*", "GGG#00", "FFFFFFFF#"],
)
def test_an_invalid_frame_is_rejected(text):
    with pytest.raises(BenchError):
        parse_frame(text)


def test_dots_in_a_pattern_stand_for_any_byte():
    assert matches(pattern("1f 7f .. 1f ff"), "1F7F031FFF")
    assert not matches(pattern("1f 7f .. 1f ff"), "1F7F03041FFF")
    assert matches(pattern("05850401#..02"), "05850401#FF02")


def test_a_star_at_the_end_of_a_pattern_stands_for_any_bytes():
    assert matches(pattern("1f 7f *"), "1F7F")
    assert matches(pattern("1f 7f *"), "1F7F031FFF")
    assert not matches(pattern("1f 7f *"), "1F07")
    assert matches(pattern("181#2a*"), "181#2A00")
    assert not matches(pattern("181#2a*"), "182#2A00")
    with pytest.raises(BenchError, match="not bytes in hexadecimal or a CAN frame"):
        pattern("1f * 7f")


def test_percentiles_are_nearest_rank():
    values = [float(n) for n in range(1, 101)]
    assert (percentile(values, 0.5), percentile(values, 0.99), percentile(values, 1.0)) == (50.0, 99.0, 100.0)
    assert math.isnan(percentile([], 0.5))
