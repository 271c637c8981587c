"""Image download: frame by frame with checksums, or in bursts with hole maps."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from starhil.hil_tests.errors import BadReplyError, BenchError, NackError
from starhil.hil_tests.transactions import Reading
from starhil.protocol.image_transfer import (
    FRAME_SIZE,
    MAP_PARTS,
    MAX_BLOCK,
    HoleMap,
    block_checksum,
    frame_checksum,
    packet_count,
    parse_burst_packet,
)
from starhil.protocol.messages import ErrorCode
from starhil.protocol.values import Value


class Downloader(Protocol):
    """The methods of a client that a download uses."""

    bursts: asyncio.Queue[bytes]

    async def command(self, name: str, values: Mapping[str, Value] | None = None) -> object:
        """Send a telecommand."""

    async def read(self, name: str) -> Reading:
        """Read telemetry with its latency."""
        ...

    async def telemetry(self, name: str) -> Mapping[str, Value]:
        """Read telemetry as values by name."""
        ...


FRAME_ATTEMPTS: Final = 3
"""Number of attempts to read a frame with a wrong checksum."""
POLL_S: Final = 0.04
"""Polling period, as in public flight software."""

BMP_HEADER_SIZE: Final = 54
"""Size of the two headers of a BMP file."""
BURST_ROUNDS: Final = 20
"""Number of requests for the missing packets of a block."""
BURST_SILENCE_S: Final = 0.5
"""Silence that ends a burst."""


@dataclass(frozen=True)
class Image:
    """A downloaded grey image of 8 bits per pixel.

    Attributes
    ----------
    pixels : bytes
        `width * height` bytes, row by row from the top.
    bytes_received : int
        Payload bytes received, including repeats.
    repeats : int
        Frames or bursts that were requested again.
    seconds : float
        Duration of the download, without the capture.
    """

    pixels: bytes
    width: int
    height: int
    bytes_received: int
    repeats: int
    seconds: float


async def save_image(client: Downloader, size: str, *, within_s: float) -> None:
    """Capture an image and wait until it is stored."""
    await client.command("save_image", {"camera": "star", "image_size": size})
    deadline = time.monotonic() + within_s
    while True:
        state = await client.telemetry("image_status")
        if state["status"] in ("checksum_error", "storage_error"):
            raise BenchError(f"save_image: the device reports {state['status']!r}")
        if state["percent"] == 100 and state["status"] == "ok":
            return
        if time.monotonic() > deadline:
            raise BenchError(
                f"save_image: not done within {within_s:g} s ({state['percent']!r} %, {state['status']!r})"
            )
        await asyncio.sleep(POLL_S)


async def download_by_frames(client: Downloader, size: str, *, within_s: float) -> Image:
    """Save an image and download it in frames of 128 bytes, each with a checksum.

    Raises
    ------
    BadReplyError
        The number or checksum of a frame stays wrong.
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


async def _read_frame(client: Downloader, number: int) -> tuple[bytes, int]:
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


async def _when_not_busy(client: Downloader, name: str, within_s: float, values: Mapping[str, Value]) -> None:
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


async def download_by_bursts(client: Downloader, size: str, *, within_s: float) -> Image:
    """Save an image and download its file in bursts of up to 1024 numbered packets.

    The header of the file, loaded first, contains its length.
    """
    await save_image(client, size, within_s=within_s)
    begin = time.monotonic()
    header, repeats = await _download_block(client, 0, BMP_HEADER_SIZE, within_s)
    length = bmp_file_size(header)
    data = bytearray()
    while len(data) < length:
        block, rounds = await _download_block(client, len(data), min(MAX_BLOCK, length - len(data)), within_s)
        data += block
        repeats += rounds
    pixels, width, height = decode_bmp(bytes(data))
    return Image(pixels, width, height, len(data), repeats, time.monotonic() - begin)


async def _download_block(client: Downloader, offset: int, length: int, within_s: float) -> tuple[bytes, int]:
    """Load one block of the file and receive its packets; return it and the number of repeated requests."""
    await _when_not_busy(
        client,
        "load_file_block",
        within_s,
        {"file_type": "bmp", "file_counter": 0, "offset": offset, "length": length},
    )
    deadline = time.monotonic() + within_s
    state = await client.telemetry("file_block")
    while not state["ready"]:
        if state["parameter_error"]:
            raise BadReplyError(f"load_file_block: the device has no {length} bytes at {offset} of the file")
        if time.monotonic() > deadline:
            raise BenchError(f"load_file_block: offset {offset} not ready within {within_s:g} s")
        await asyncio.sleep(POLL_S)
        state = await client.telemetry("file_block")
    if state["length"] != length:
        raise BadReplyError(f"file block at {offset}: {state['length']!r} bytes loaded, {length} requested")
    count = packet_count(length)
    packets: dict[int, bytes] = {}
    for repeats in range(BURST_ROUNDS):
        while not client.bursts.empty():
            client.bursts.get_nowait()
        await client.command("start_burst", {"ignore_hole_map": repeats == 0})
        await _gather(client, packets, count)
        if len(packets) == count:
            block = b"".join(packets[number] for number in range(count))[:length]
            if block_checksum(block) == state["checksum"]:
                return block, repeats
            packets.clear()
        await _send_hole_map(client, packets)
    raise BadReplyError(
        f"file block at {offset}: {count - len(packets)} of {count} packets missing or wrong "
        f"after {BURST_ROUNDS} bursts"
    )


async def _gather(client: Downloader, packets: dict[int, bytes], count: int) -> None:
    """Receive burst packets until all have arrived or the line is silent."""
    while len(packets) < count:
        try:
            async with asyncio.timeout(BURST_SILENCE_S):
                packet = await client.bursts.get()
        except TimeoutError:
            return
        number, data = parse_burst_packet(packet)
        if number < count:
            packets[number] = data


async def _send_hole_map(client: Downloader, packets: dict[int, bytes]) -> None:
    """Send the device the map of the packets that have arrived."""
    holes = HoleMap(packets)
    for part in range(1, MAP_PARTS + 1):
        await client.command(f"set_hole_map_{part}", {"map": holes.part(part)})


def bmp_file_size(header: bytes) -> int:
    """Return the length of a BMP file from its header.

    Raises
    ------
    BadReplyError
        The data are not the header of a BMP file.
    """
    if len(header) < BMP_HEADER_SIZE or header[:2] != b"BM":
        raise BadReplyError(f"the downloaded file is not a BMP image: it begins with {header[:8].hex(' ')}")
    return int(struct.unpack_from("<I", header, 2)[0])


def decode_bmp(data: bytes) -> tuple[bytes, int, int]:
    """Return pixels (row by row from the top), width and height of an 8-bit grey BMP file.

    Raises
    ------
    BadReplyError
        The data are not such a file, or are truncated.
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
