"""The identification index on disk: written atomically, verified by a checksum, and mapped into memory.

Layout: magic, length of the header (u64, little-endian), header (JSON: key, checksum of the data, and name,
dtype, shape and offset of each array), then the arrays, each aligned to 64 bytes.
"""

from __future__ import annotations

import json
import logging
import mmap
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.identification.geometric.pattern_index import IndexArrays
from starid.storage.cache import CACHED_MODE
from starid.storage.files import write_atomically

_log = logging.getLogger(__name__)

_MAGIC: Final = b"STARHIDX"
_ALIGNMENT: Final = 64
_LENGTH_BYTES: Final = 8


def _padded(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT


def pack(arrays: IndexArrays, key: str) -> bytes:
    """Serialise an index."""
    table = []
    data = bytearray()
    for name, array in arrays._asdict().items():
        data.extend(bytes(_padded(len(data)) - len(data)))
        table.append({"name": name, "dtype": array.dtype.str, "shape": array.shape, "offset": len(data)})
        data.extend(array.tobytes())
    header = json.dumps({"key": key, "crc32": zlib.crc32(data), "arrays": table}).encode()
    head = _MAGIC + len(header).to_bytes(_LENGTH_BYTES, "little") + header
    return head.ljust(_padded(len(head)), b"\0") + bytes(data)


def unpack(buffer: bytes | mmap.mmap, key: str) -> IndexArrays:
    """Parse an index file into arrays, which are read-only views into the buffer.

    Raises
    ------
    ValueError
        The bytes are not an index, are damaged, or belong to another key.
    """
    prefix = len(_MAGIC) + _LENGTH_BYTES
    if buffer[: len(_MAGIC)] != _MAGIC:
        raise ValueError("not an index file")
    header_end = prefix + int.from_bytes(buffer[len(_MAGIC) : prefix], "little")
    if header_end > len(buffer):
        raise ValueError("header is truncated")
    header: dict[str, Any] = json.loads(buffer[prefix:header_end])
    if header["key"] != key:
        raise ValueError("made for another catalogue, camera or version")
    data = memoryview(buffer)[_padded(header_end) :]
    if zlib.crc32(data) != header["crc32"]:
        raise ValueError("checksum does not match the data")
    views: dict[str, NDArray[Any]] = {}
    for entry in header["arrays"]:
        count = int(np.prod(entry["shape"], dtype=np.int64))
        flat = np.frombuffer(data, dtype=np.dtype(entry["dtype"]), count=count, offset=entry["offset"])
        views[entry["name"]] = flat.reshape(entry["shape"])
    return IndexArrays(**views)


def load(path: Path, key: str) -> IndexArrays | None:
    """Map an index file; log a warning and return None if it is damaged or belongs to another index."""
    try:
        with path.open("rb") as stream:
            return unpack(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ), key)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        _log.warning("index file %s is not usable (%s): built again", path, error)
        return None


def store(path: Path, arrays: IndexArrays, key: str) -> IndexArrays:
    """Write an index file and map it; if that fails, the index stays in memory."""
    content = pack(arrays, key)
    try:
        write_atomically(path, lambda part: _write(part, content), mode=CACHED_MODE)
    except OSError as error:
        _log.warning("index file %s cannot be written (%s): built again each time", path, error)
        return unpack(content, key)
    return load(path, key) or unpack(content, key)


def _write(part: Path, content: bytes) -> None:
    part.write_bytes(content)
