"""Image download, frame by frame with checksums or in bursts with hole maps, and PNG files."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from starhil.hil_tests.client.async_client import AsyncObcClient
from starhil.hil_tests.client.transactions import Reading
from starhil.hil_tests.errors import BadReplyError, BenchError, NackError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.values import Value
from starhil.protocol.image_transfer import (
    FRAME_SIZE,
    MAP_PARTS,
    MAX_BLOCK,
    HoleMap,
    file_checksum,
    frame_checksum,
    packet_count,
    parse_burst_packet,
)
from starhil.protocol.messages import ErrorCode
from starid.storage.files import write_atomically

FRAME_ATTEMPTS: Final = 3
"""Number of attempts to read a frame with a wrong checksum."""
POLL_S: Final = 0.04
"""Polling period, as in public flight software."""

BMP_HEADER_SIZE: Final = 54
"""Size of the two headers of a BMP file."""
LARGEST_FILE: Final = 64 * 1024 * 1024
"""Size of a stored file above which it is not downloaded, bytes."""
FILES_MAX: Final = 1000
"""Number of files after which a list without end is given up."""
BURST_ROUNDS: Final = 20
"""Number of requests for the missing packets of a block."""
BURST_SILENCE_S: Final = 0.5


@dataclass(frozen=True)
class Image:
    """A downloaded grey image of 8 bits per pixel."""

    pixels: bytes
    """`width * height` bytes, row by row from the top."""
    width: int
    height: int
    bytes_received: int
    """Payload bytes received, including repeats."""
    repeats: int
    """Frames or bursts that were requested again."""
    seconds: float
    """Duration of the download, without the capture."""


def check_download(icd: InterfaceDefinition, size: str) -> None:
    """Check that a unit has images as CubeStar has them, in a size.

    Raises ProtocolError: it has none, or the size is unknown; the text gives the sizes.
    """
    if "save_image" not in icd.telecommands:
        raise ProtocolError(
            f"unit {icd.name} has no telecommand save_image: only images of CubeStar's kind can be downloaded"
        )
    try:
        icd.enums["image_size"].number(size)
    except ProtocolError as error:
        raise ProtocolError(f"size: {error}") from None


async def download_image(
    client: AsyncObcClient, size: str = "size_128", *, method: str = "frames", within_s: float = 120.0
) -> Image:
    """Capture and store an image, and download it by `frames` or by `burst`."""
    if method not in ("frames", "burst"):
        raise BenchError(f"image download method '{method}': must be frames or burst")
    download = download_by_frames if method == "frames" else download_by_bursts
    return await download(client, size, within_s=within_s)


async def save_image(client: AsyncObcClient, size: str, *, within_s: float) -> None:
    """Capture an image and wait until it is stored."""

    def is_stored(state: Reading) -> bool:
        if state["status"] in ("checksum_error", "storage_error"):
            raise BenchError(f"save_image: the device reports {state['status']!r}")
        return state["percent"] == 100 and state["status"] == "ok"

    await client.command("save_image", {"camera": "star", "image_size": size})
    await client.wait_for("image_status", is_stored, within_s=within_s, every_s=POLL_S)


async def download_by_frames(client: AsyncObcClient, size: str, *, within_s: float) -> Image:
    """Save an image and download it in frames of 128 bytes, each with a checksum.

    Raises BadReplyError: the number or checksum of a frame stays wrong.
    """
    edge = int(size.removeprefix("size_"))
    await save_image(client, size, within_s=within_s)
    begin = time.monotonic()
    await _when_not_busy(client, "init_image_download", within_s, {"image_size": size})
    pixels = bytearray()
    repeats = 0
    for number in range(edge * edge // FRAME_SIZE):
        if number > 0:
            await _when_not_busy(client, "advance_image_download", within_s, {"next_frame": number})
        data, attempts = await _read_frame(client, number)
        pixels += data
        repeats += attempts - 1
    received = len(pixels) + repeats * FRAME_SIZE
    return Image(bytes(pixels), edge, edge, received, repeats, time.monotonic() - begin)


async def _read_frame(client: AsyncObcClient, number: int) -> tuple[bytes, int]:
    """Read the loaded frame and check it; return it and the number of attempts."""
    problem = ""
    for attempt in range(1, FRAME_ATTEMPTS + 1):
        data = (await client.read("image_frame"))["data"]
        info = await client.telemetry("image_frame_info")
        if not isinstance(data, bytes):
            raise BadReplyError("image_frame.data: not bytes")
        if info["frame"] != number:
            problem = f"the device has loaded frame {info['frame']!r}"
        elif info["checksum"] != frame_checksum(data):
            problem = f"checksum {info['checksum']!r}, the bytes give {frame_checksum(data)}"
        else:
            return data, attempt
    raise BadReplyError(f"image frame {number}: {problem}")


async def _when_not_busy(
    client: AsyncObcClient, name: str, within_s: float, values: Mapping[str, Value]
) -> None:
    """Send a telecommand, and repeat it while the device reports busy."""
    deadline = time.monotonic() + within_s
    while True:
        try:
            await client.command(name, values)
        except NackError as error:
            if error.code != ErrorCode.BUSY or time.monotonic() > deadline:
                raise
            await asyncio.sleep(POLL_S)
        else:
            return


# --- bursts ---


async def download_by_bursts(client: AsyncObcClient, size: str, *, within_s: float) -> Image:
    """Save an image, and download the newest file of the list in bursts of up to 1024 numbered packets.

    Raises BadReplyError: the list is empty, or the file does not have the checksum in the list.
    """
    await save_image(client, size, within_s=within_s)
    begin = time.monotonic()
    files = await list_files(client, within_s=within_s)
    if not files:
        raise BadReplyError("file_info: the list of files is empty after save_image")
    file = files[-1]
    data, repeats, total = b"", 0, int(file["size"])
    if total > LARGEST_FILE:
        raise BadReplyError(
            f"file_info.size: {total} bytes are no image; at most {LARGEST_FILE} are downloaded"
        )
    while len(data) < total:
        left = min(MAX_BLOCK, total - len(data))
        block, rounds = await _download_block(client, int(file["counter"]), len(data), left, within_s)
        data += block
        repeats += rounds
    if file_checksum(data) != file["crc"]:
        raise BadReplyError(
            f"the downloaded file has checksum {file_checksum(data)}, the list {file['crc']!r}"
        )
    pixels, width, height = decode_bmp(data)
    return Image(pixels, width, height, len(data), repeats, time.monotonic() - begin)


async def list_files(client: AsyncObcClient, *, within_s: float) -> list[Mapping[str, Any]]:
    """Return the information of each stored file, as `file_info` reports it, oldest first."""
    await client.command("reset_file_list")
    files: list[Mapping[str, Any]] = []
    while len(files) < FILES_MAX:
        info = await client.wait_for(
            "file_info", lambda state: not state["updating"], within_s=within_s, every_s=POLL_S
        )
        if not any(info.values.values()):
            return files
        files.append(info.values)
        await client.command("advance_file_list")
    raise BadReplyError(f"file_info: the list does not end after {FILES_MAX} files")


async def _download_block(
    client: AsyncObcClient, counter: int, offset: int, left: int, within_s: float
) -> tuple[bytes, int]:
    """Load one block of the file and receive its packets; return it and the number of repeated requests.

    `left` is its length, as large as a block can be, or to the end of the file.
    """
    block: dict[str, Value] = {
        "file_type": "bmp",
        "file_counter": counter,
        "offset": offset,
        "length": MAX_BLOCK,
    }
    await _when_not_busy(client, "load_file_block", within_s, block)

    def is_loaded(state: Reading) -> bool:
        if state["parameter_error"] and not state["ready"]:
            raise BadReplyError(f"load_file_block: the device has no bytes at {offset} of file {counter}")
        return bool(state["ready"])

    state = await client.wait_for("file_block", is_loaded, within_s=within_s, every_s=POLL_S)
    length = int(state["length"])
    if length != left:
        raise BadReplyError(f"file_block.length: must be {left} at {offset} of file {counter}, is {length}")
    count = packet_count(length)
    packets: dict[int, bytes] = {}
    for repeats in range(BURST_ROUNDS):
        while not client.bursts.empty():
            client.bursts.get_nowait()
        await client.command("start_burst", {"ignore_hole_map": repeats == 0})
        await _gather(client, packets, count)
        if len(packets) == count:
            data = b"".join(packets[number] for number in range(count))[:length]
            if file_checksum(data) == state["checksum"]:
                return data, repeats
            packets.clear()
        await _send_hole_map(client, packets)
    raise BadReplyError(
        f"file block at {offset}: {count - len(packets)} of {count} packets missing or wrong "
        f"after {BURST_ROUNDS} bursts"
    )


async def _gather(client: AsyncObcClient, packets: dict[int, bytes], count: int) -> None:
    """Receive burst packets until all have arrived or the line is silent.

    A message of another length is a damaged packet, which counts as lost: segments on CAN count down, so where the
    first one is lost, the next one looks like the first of a shorter message.
    """
    while len(packets) < count:
        try:
            async with asyncio.timeout(BURST_SILENCE_S):
                packet = await client.bursts.get()
        except TimeoutError:
            return
        try:
            number, data = parse_burst_packet(packet)
        except ProtocolError:
            continue
        if number < count:
            packets[number] = data


async def _send_hole_map(client: AsyncObcClient, packets: dict[int, bytes]) -> None:
    """Send the device the map of the packets that have arrived."""
    holes = HoleMap.of(packets)
    for part in range(1, MAP_PARTS + 1):
        await client.command(f"set_hole_map_{part}", {"map": holes.part(part)})


def decode_bmp(data: bytes) -> tuple[bytes, int, int]:
    """Return pixels (row by row from the top), width and height of an 8-bit grey BMP file.

    Raises BadReplyError: the data are not such a file, or are truncated.
    """
    if len(data) < BMP_HEADER_SIZE or data[:2] != b"BM":
        raise BadReplyError(f"the downloaded file of {len(data)} bytes is not a BMP image")
    (start,) = struct.unpack_from("<I", data, 10)
    width, signed_height, _planes, depth, compression = struct.unpack_from("<iiHHI", data, 18)
    height = abs(signed_height)
    stride = (width + 3) // 4 * 4
    if depth != 8 or compression != 0 or width < 1 or height < 1 or len(data) < start + stride * height:
        raise BadReplyError(
            f"the downloaded BMP image ({width}x{height}, {depth} bits) is truncated or not 8-bit grey"
        )
    rows = [data[start + row * stride : start + row * stride + width] for row in range(height)]
    if signed_height > 0:
        rows.reverse()
    return b"".join(rows), width, height


def write_png(path: Path, pixels: bytes, width: int, height: int) -> None:
    """Write a grey image atomically.

    `pixels` has 8 bits per pixel, row by row from the top.

    Raises BenchError: the number of bytes does not match the size.
    """
    import cv2
    import numpy as np

    if width < 1 or height < 1 or len(pixels) != width * height:
        raise BenchError(f"an image of {width}x{height} needs {width * height} bytes, not {len(pixels)}")
    _, data = cv2.imencode(".png", np.frombuffer(pixels, np.uint8).reshape(height, width))
    write_atomically(path, lambda part: part.write_bytes(data.tobytes()))
