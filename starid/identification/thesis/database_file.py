"""The file of a feature database: a header with parameters and checksums, then memory-mapped arrays."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import mmap
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.identification.thesis.database import DatabaseError, DatabaseParameters, FeatureDatabase
from starid.identification.thesis.features import FEATURE_COUNT
from starid.identification.thesis.frame_grid import make_grid
from starid.identification.thesis.frame_sky import BRIGHTNESS, DECLINATION, RIGHT_ASCENSION, make_frame_sky
from starid.storage.files import open_regular, write_atomically

MAGIC: Final = b"starhil features"
"""First 16 bytes of a database file."""

FORMAT_VERSION: Final = 1

_LENGTH: Final = struct.Struct("<I")
_ALIGNMENT: Final = 64
_CHECKSUM_BYTES: Final = 16
_STAR_COLUMNS: Final = 3
_MAX_HEADER: Final = 1 << 20


def _checksum(header: dict[str, Any], *blocks: Any) -> str:
    digest = hashlib.blake2b(digest_size=_CHECKSUM_BYTES)
    digest.update(json.dumps(header, sort_keys=True).encode())
    for block in blocks:
        digest.update(block)
    return digest.hexdigest()


def _payload_start(header_length: int) -> int:
    raw = len(MAGIC) + _LENGTH.size + header_length
    return -(-raw // _ALIGNMENT) * _ALIGNMENT


def save_database(database: FeatureDatabase, path: Path) -> int:
    """Write a database atomically; return the size of the file in bytes.

    Layout: 16 bytes "starhil features", header length (uint32, little-endian), header (JSON), padding to 64
    bytes, features (N, 5) uint8, polar angles (N,) uint8, stars (n, 3) float64 (magnitude, α, δ in degrees).

    Raises
    ------
    DatabaseError
        The file cannot be written.
    """
    table = database.sky.stars[:, [BRIGHTNESS, RIGHT_ASCENSION, DECLINATION]]
    stars = np.ascontiguousarray(table, dtype="<f8")
    features, theta = np.ascontiguousarray(database.features), np.ascontiguousarray(database.theta)
    header: dict[str, Any] = {
        "version": FORMAT_VERSION,
        "parameters": dataclasses.asdict(database.parameters),
        "catalog": database.catalog_identity,
        "cells": database.cells,
        "stars": int(stars.shape[0]),
        "minimum": database.minimum.tolist(),
        "maximum": database.maximum.tolist(),
    }
    header["checksum"] = _checksum(header, features.data, theta.data, stars.data)
    text = json.dumps(header, sort_keys=True).encode()
    head = MAGIC + _LENGTH.pack(len(text)) + text
    head += b"\0" * (_payload_start(len(text)) - len(head))

    def write(part: Path) -> None:
        with part.open("wb") as file:
            for block in (head, features.data, theta.data, stars.data):
                file.write(block)

    try:
        write_atomically(path, write)
    except OSError as error:
        raise DatabaseError(f"database: {path} cannot be written ({error.strerror or error})") from error
    return len(head) + features.nbytes + theta.nbytes + stars.nbytes


def read_header(path: Path) -> dict[str, Any]:
    """Read the header of a database file.

    Raises
    ------
    DatabaseError
        There is no such file, or it is not a feature database of this version.
    """
    try:
        with open_regular(path) as file:
            start = file.read(len(MAGIC) + _LENGTH.size)
            if start[: len(MAGIC)] != MAGIC:
                raise DatabaseError(
                    f"database: {path} is not a feature database; build one with `starid database build`"
                )
            if len(start) < len(MAGIC) + _LENGTH.size:
                raise DatabaseError(f"database: {path} has a truncated header; build it again")
            (length,) = _LENGTH.unpack(start[len(MAGIC) :])
            text = file.read(min(length, _MAX_HEADER))
    except OSError as error:
        raise DatabaseError(f"database: {path} cannot be read ({error.strerror or error})") from error
    if len(text) < length:
        raise DatabaseError(f"database: {path} has a truncated header; build it again")
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatabaseError(f"database: {path} has a damaged header; build it again") from error
    if not isinstance(header, dict) or header.get("version") != FORMAT_VERSION:
        raise DatabaseError(
            f"database: {path} has another format version than {FORMAT_VERSION}; build it again"
        )
    header["payload_start"] = _payload_start(length)
    return header


def load_database(path: Path, *, verify: bool = True) -> FeatureDatabase:
    """Map a database file into memory.

    Parameters
    ----------
    path
        File written by `save_database`.
    verify
        Verify the checksum of the whole file (about 40 ms for 30 MB).

    Raises
    ------
    DatabaseError
        The file is missing, truncated, damaged, of another version, or not a database.
    """
    header = read_header(path)
    start = int(header.pop("payload_start"))
    try:
        parameters = DatabaseParameters.from_dict(header["parameters"])
        cells, star_count = int(header["cells"]), int(header["stars"])
        minimum = np.array(header["minimum"], dtype=np.float64)
        maximum = np.array(header["maximum"], dtype=np.float64)
        checksum, identity = str(header.pop("checksum")), str(header["catalog"])
    except (KeyError, TypeError, ValueError) as error:
        raise DatabaseError(f"database: {path} has a damaged header ({error}); build it again") from error
    sizes = (cells * FEATURE_COUNT, cells, star_count * _STAR_COLUMNS * 8)
    if path.stat().st_size != start + sum(sizes):
        raise DatabaseError(
            f"database: {path} is truncated: {path.stat().st_size} bytes instead of {start + sum(sizes)}; build it again"
        )
    with path.open("rb") as file:
        view = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    ends = np.cumsum((start, *sizes)).tolist()
    features, theta, stars = (view[a:b] for a, b in itertools.pairwise(ends))
    if verify and _checksum(header, features, theta, stars) != checksum:
        raise DatabaseError(f"database: {path} is damaged: its checksum does not match; build it again")
    grid = make_grid(parameters.geometry, parameters.fov_deg, parameters.overlap)
    if grid.cells != cells:
        raise DatabaseError(
            f"database: {path} has {cells} cells, but its parameters define {grid.cells}; build it again"
        )
    table = np.frombuffer(stars, dtype="<f8").reshape(star_count, _STAR_COLUMNS)
    sky = make_frame_sky(
        table[:, 1],
        table[:, 2],
        table[:, 0],
        geometry=parameters.geometry,
        half_width=parameters.half_width,
        kappa=-math.inf,
        direction="faintest",
        full_field=parameters.full_field,
        focal_px=parameters.focal_px,
    )
    return FeatureDatabase(
        parameters,
        grid,
        sky,
        _bytes(features).reshape(cells, FEATURE_COUNT),
        _bytes(theta),
        minimum,
        maximum,
        identity,
    )


def _bytes(view: memoryview) -> NDArray[np.uint8]:
    return np.frombuffer(view, dtype=np.uint8)
