"""Files for download: their list, loading in blocks, bursts of numbered packets, and the hole map of received packets.

The files are the stored images as `bmp`, those compressed from them as `jpg`, and an `index` with 12 bytes per file:
`<type u8, counter u8, edge u16, size u32, frame u32>`. The layout of the index is not public; this one is our own
choice.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from starhil.emulator.device.images import ImageStore
from starhil.emulator.device.stored_images import FileState
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.image_transfer import (
    MAX_BLOCK,
    MAX_PACKETS,
    HoleMap,
    burst_packet,
    packet_count,
)
from starhil.protocol.messages import BURST_ID, Reply, ReplyKind

INDEX_ENTRY: Final = struct.Struct("<BBHII")

LOOKUP_S: Final = 0.02
"""Modelled time until the information of the next file is valid, seconds."""
ERASE_S: Final = 0.1
"""Modelled time to erase files, seconds."""


class FileDownload:
    """The list of files, the loaded block, and the map of its packets that have arrived."""

    def __init__(self, images: ImageStore, now_ns: Callable[[], int]) -> None:
        self._images = images
        self._now_ns = now_ns
        self.clear()

    def clear(self) -> None:
        """Discard the block and the hole map, and begin the list again."""
        self.state = FileState()
        """The present state; each change makes a new one."""

    def _change(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    # --- the list ---

    def rewind(self) -> None:
        self._go_to(0)

    def advance(self) -> None:
        self._go_to(self.state.position + 1)

    def _go_to(self, position: int) -> None:
        looked_up_ns = self._now_ns() + round(LOOKUP_S * NANOSECONDS)
        self._change(position=min(position, len(self._images.state.files)), looked_up_ns=looked_up_ns)

    def erase(self, file_type: str, counter: int) -> bool:
        """Erase a file; return False if it does not exist."""
        return self._images.erase(file_type, counter)

    def erase_all(self, *, formatting: bool) -> None:
        """Erase all files, which takes `ERASE_S`."""
        self._images.erase_all()
        self._change(erased_ns=self._now_ns() + round(ERASE_S * NANOSECONDS), formatting=formatting)

    # --- a block ---

    def load(self, file_type: str, counter: int, offset: int, length: int) -> bool:
        """Load a block of a file, at most up to its end; return False if there is no such file or byte.

        A length of 1024 is that of a whole block in packets.
        """
        wanted = MAX_BLOCK if length == MAX_PACKETS else length
        block = self._file(file_type, counter)[offset : offset + wanted]
        self._change(block=block, parameter_error=not block, packets=(0,), arrived=HoleMap())
        return bool(block)

    def _file(self, file_type: str, counter: int) -> bytes:
        if file_type == "index":
            return b"".join(
                INDEX_ENTRY.pack(file.type, file.number, file.edge, file.file_size, file.frame)
                for file in self._images.state.files
            )
        newest_first = reversed(self._images.state.files)
        chosen = (file for file in newest_first if file.kind == file_type and counter in (0, file.number))
        file = next(chosen, None)
        return b"" if file is None else file.content()

    def burst(self, *, ignore_hole_map: bool) -> list[Reply]:
        """Return the packets of the block, by default only those missing in the hole map."""
        block, count = self.state.block, packet_count(len(self.state.block))
        numbers = tuple(range(count) if ignore_hole_map else self.state.arrived.missing(count))
        self._change(packets=numbers or self.state.packets)
        return [Reply(ReplyKind.BURST, BURST_ID, burst_packet(block, number)) for number in numbers]

    def next_packet(self) -> None:
        """Go to the next packet of the last burst; the last one stays."""
        if len(self.state.packets) > 1:
            self._change(packets=self.state.packets[1:])

    def set_hole_map(self, part: int, data: bytes) -> None:
        """Report which packets of a part of the block have arrived."""
        self._change(arrived=self.state.arrived.with_part(part, data))
