"""Downloads from a device that damages, loses or withholds: the image is whole, or the error names what is wrong."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import pytest

from starhil.hil_tests.client import AsyncObcClient, images
from starhil.hil_tests.client.images import download_by_bursts, download_by_frames, list_files
from starhil.hil_tests.client.transactions import Reading
from starhil.hil_tests.errors import BenchError, NackError
from starhil.protocol.can.cubespace import CanHostReceiver, encode_reply_frames
from starhil.protocol.image_transfer import burst_packet, file_checksum, frame_checksum, packet_count
from starhil.protocol.messages import BURST_ID, ErrorCode, Reply, ReplyKind
from tests.waiting import PATIENCE_S

PIXELS = np.arange(64 * 64, dtype=np.uint8).reshape(64, 64)
FILE = cv2.imencode(".bmp", PIXELS)[1].tobytes()


class Device:
    """A device that holds one image; `wrong` replaces what it reports, `lost` are packets lost in the first burst."""

    def __init__(
        self, wrong: Mapping[str, Mapping[str, Any]] | None = None, lost: tuple[int, ...] = (), busy: int = 0
    ) -> None:
        self.bursts: asyncio.Queue[bytes] = asyncio.Queue()
        self.wrong, self.lost, self.busy = wrong or {}, set(lost), busy
        self.frame = self.listed = self.reads = 0
        self.block = b""

    async def command(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        if name == "init_image_download" and self.busy:
            self.busy -= 1
            raise NackError(name, ErrorCode.BUSY, "busy")
        match name:
            case "advance_image_download":
                self.frame = values["next_frame"]
            case "advance_file_list":
                self.listed += 1
            case "load_file_block":
                self.block = FILE[values["offset"] : values["offset"] + values["length"]]
            case "start_burst":
                for number in range(packet_count(len(self.block))):
                    if number not in self.lost:
                        self.bursts.put_nowait(burst_packet(self.block, number))
                self.lost.clear()

    wait_for = AsyncObcClient.wait_for

    async def read(self, name: str) -> Reading:
        if name != "image_frame":
            return Reading(name, await self.telemetry(name), 0.0, 0.0, 0.0)
        self.reads += 1
        damaged = name in self.wrong.get("damage", {}).get("rows", ()) and self.reads % 2
        data = bytearray(PIXELS.tobytes()[self.frame * 128 : self.frame * 128 + 128])
        data[5] ^= damaged
        return Reading(name, {"data": bytes(data)}, 0.0, 0.0, 0.0)

    async def telemetry(self, name: str) -> Mapping[str, Any]:
        frame = PIXELS.tobytes()[self.frame * 128 : self.frame * 128 + 128]
        right = {
            "image_status": {"status": "ok", "percent": 100},
            "image_frame_info": {"frame": self.frame, "checksum": frame_checksum(frame)},
            "file_info": {"updating": False, "counter": 1, "size": len(FILE), "crc": file_checksum(FILE)}
            if self.listed == 0
            else {"updating": False, "counter": 0},
            "file_block": {
                "ready": True, "parameter_error": False, "length": len(self.block), "checksum": file_checksum(self.block),
            },
        }  # fmt: skip
        return {**right[name], **self.wrong.get(name, {})}


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch):
    monkeypatch.setattr(images, "POLL_S", 0.0)
    monkeypatch.setattr(images, "BURST_SILENCE_S", 0.01)


def test_a_frame_with_a_wrong_checksum_is_read_again():
    device = Device({"damage": {"rows": ["image_frame"]}}, busy=2)
    image = asyncio.run(download_by_frames(device, "size_64", within_s=PATIENCE_S))
    assert image.pixels == PIXELS.tobytes()
    assert image.repeats == 32  # each of the frames once


def test_packets_that_were_lost_are_requested_again():
    image = asyncio.run(download_by_bursts(Device(lost=(0, 7, 100)), "size_64", within_s=PATIENCE_S))
    assert (image.pixels, image.repeats) == (PIXELS.tobytes(), 1)


class LossyCanDevice(Device):
    """The device on a CAN bus that loses some frames of the first burst, counted from its begin."""

    def __init__(self, lost_frames: tuple[int, ...]) -> None:
        super().__init__()
        self.lost_frames = set(lost_frames)

    async def command(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        await super().command(name, values)
        if name != "start_burst":
            return
        packets = [self.bursts.get_nowait() for _ in range(self.bursts.qsize())]
        frames = [
            frame
            for packet in packets
            for frame in encode_reply_frames(Reply(ReplyKind.BURST, BURST_ID, packet, destination=1), 4)
        ]
        receiver = CanHostReceiver(1, 4)
        for number, frame in enumerate(frames):
            for event in receiver.feed(frame, 0.0) if number not in self.lost_frames else ():
                if isinstance(event, Reply):
                    self.bursts.put_nowait(event.data)
        self.lost_frames.clear()


@pytest.mark.parametrize("place", range(4), ids=("first", "second", "third", "last"))
def test_a_lost_can_frame_costs_its_packet_not_the_download(place):
    device = LossyCanDevice((4 * 7 + place, 4 * 100 + place))
    image = asyncio.run(download_by_bursts(device, "size_64", within_s=PATIENCE_S))
    assert (image.pixels, image.repeats) == (PIXELS.tobytes(), 1)


@pytest.mark.parametrize(
    ("row", "values", "words"),
    [
        ("image_status", {"status": "storage_error"}, "save_image: the device reports 'storage_error'"),
        (
            "image_status",
            {"percent": 50},
            "image_status: the condition did not hold within 0 s; last values .*50",
        ),
        ("image_frame_info", {"frame": 9}, "image frame 0: the device has loaded frame 9"),
        ("image_frame_info", {"checksum": 0}, "image frame 0: checksum 0, the bytes give"),
        ("file_info", {"updating": True}, "file_info: the condition did not hold within 0 s"),
        ("file_info", {"counter": 1}, "file_info: the list does not end after 1000 files"),
        ("file_info", {"updating": False, "counter": 0, "size": 0, "crc": 0}, "the list of files is empty"),
        ("file_block", {"ready": False}, "file_block: the condition did not hold within 0 s"),
        ("file_block", {"ready": False, "parameter_error": True}, "the device has no bytes at 0 of file 1"),
        ("file_block", {"checksum": -1}, "packets missing or wrong after 20 bursts"),
        ("file_block", {"length": 0, "checksum": 0}, "length: must be [0-9]+ at 0 of file 1, is 0"),
    ],
)
def test_what_the_device_does_wrong_is_named(row, values, words):
    download = download_by_frames if row.startswith("image_frame") else download_by_bursts
    with pytest.raises(BenchError, match=words):
        asyncio.run(download(Device({row: values}), "size_64", within_s=0.0))


def test_a_file_with_another_checksum_than_in_the_list_is_rejected():
    device = Device()
    real = device.telemetry

    async def telemetry(name):
        return {**await real(name), **({"crc": 1} if name == "file_info" and device.listed == 0 else {})}

    device.telemetry = telemetry
    with pytest.raises(BenchError, match=r"the downloaded file has checksum \d+, the list 1"):
        asyncio.run(download_by_bursts(device, "size_64", within_s=PATIENCE_S))


def test_a_file_that_is_larger_than_any_image_is_not_downloaded():
    """Blocks of no bytes, or of few of a file of 4 GB, kept a session busy without end."""
    device = Device()
    real = device.telemetry

    async def telemetry(name):
        wrong = {"size": 2**32 - 1} if name == "file_info" and device.listed == 0 else {}
        return {**await real(name), **wrong}

    device.telemetry = telemetry
    with pytest.raises(BenchError, match=r"file_info.size: 4294967295 bytes are no image"):
        asyncio.run(download_by_bursts(device, "size_64", within_s=PATIENCE_S))


def test_a_refusal_other_than_busy_ends_the_download():
    device = Device(busy=10**9)
    with pytest.raises(NackError, match="init_image_download"):
        asyncio.run(download_by_frames(device, "size_64", within_s=0.0))


def test_a_list_still_being_made_is_waited_for():
    device, answers = Device(), iter((True, True, False, False, False))
    real = device.telemetry

    async def telemetry(name):
        return {**await real(name), "updating": next(answers)}

    device.telemetry = telemetry
    (file,) = asyncio.run(list_files(device, within_s=PATIENCE_S))
    assert file["size"] == len(FILE)
