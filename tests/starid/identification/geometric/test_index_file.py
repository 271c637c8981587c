"""The index on disk: mapped, and built again if it is damaged or belongs to another index."""

from __future__ import annotations

import dataclasses
import functools
import logging
from pathlib import Path

import numpy as np
import pytest

from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.identification.geometric import index_file
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.index_choice import index_settings, obtain_stars
from starid.identification.geometric.pattern_index import resolved_stars
from tests.starid.identification.geometric.sky_points import sky

pytestmark = pytest.mark.long

CAMERA = Camera.from_fov(60.0, 512, 512)
MAX_BYTES = 10_000_000
DEEP = 200_000
"""Brackets that no version of Python decodes: 3.13 decodes 9 000."""


@functools.cache
def bright() -> StarCatalog:
    return load_catalog().brighter_than(4.0)


def made(cache: Path) -> Identifier:
    return Identifier(CAMERA, bright(), limiting_magnitude=4.0, cache=cache)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("index")
    made(folder)
    (path,) = folder.iterdir()
    return path


def key_of(path: Path) -> str:
    return path.stem.removeprefix("index-")


def test_index_is_written_once_and_is_small(stored: Path) -> None:
    before = stored.stat().st_mtime_ns
    made(stored.parent)
    assert stored.stat().st_mtime_ns == before
    assert stored.stat().st_size < MAX_BYTES


def test_arrays_are_loaded_unchanged_and_read_only(stored: Path) -> None:
    mapped = index_file.load(stored, key_of(stored))
    assert mapped is not None
    again = index_file.unpack(index_file.pack(mapped, "k"), "k")
    for first, second in zip(mapped, again, strict=True):
        assert first.dtype == second.dtype
        assert np.array_equal(first, second)
        assert not first.flags.writeable


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda b: b[:0], "empty file"),
        (lambda b: b"GIF89a" + b[6:], "not an index file"),
        (lambda b: b[:40], "header is truncated"),
        (lambda b: b[: len(b) // 2], "checksum"),
        (lambda b: b[:-1], "checksum"),
        (lambda b: b[: len(b) - 1000] + bytes([b[-1000] ^ 1]) + b[len(b) - 999 :], "checksum"),
        (lambda b: b.replace(b'"key"', b'"kei"', 1), "key"),
        (lambda b: b[:8] + (1 << 62).to_bytes(8, "little") + b[16:], "header is truncated"),
        (lambda b: b[:8] + DEEP.to_bytes(8, "little") + b"[" * DEEP, "while decoding"),
    ],
    ids=["empty", "foreign", "header", "half", "one byte", "one bit", "no key", "absurd length", "deep"],
)
def test_a_damaged_file_is_reported(
    stored: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage, message: str
) -> None:
    path = tmp_path / stored.name
    path.write_bytes(damage(stored.read_bytes()))
    with caplog.at_level(logging.WARNING):
        assert index_file.load(path, key_of(stored)) is None
    assert str(path) in caplog.text
    assert message in caplog.text


def test_a_damaged_file_is_built_again(
    stored: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good, path = stored.read_bytes(), tmp_path / stored.name
    path.write_bytes(good[:-1])
    with caplog.at_level(logging.WARNING):
        identifier = made(tmp_path)
    assert str(path) in caplog.text
    assert path.read_bytes() == good
    attitude = Attitude.from_radec_roll(80.0, 10.0, 30.0)
    xy, flux, _ = sky(attitude, camera=CAMERA, limit=4.0, identified=identifier)
    assert identifier.identify(xy, flux).valid


def test_an_index_of_another_camera_is_not_used(stored: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert index_file.load(stored, "another") is None
    assert "made for another" in caplog.text


def test_an_unwritable_folder_only_prevents_caching(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with caplog.at_level(logging.WARNING):
        made(blocked)
    assert "cannot be written" in caplog.text


def test_a_sky_without_triangles_is_rejected() -> None:
    with pytest.raises(StaridError, match="raise the limiting magnitude"):
        Identifier(Camera.from_fov(5.0, 512, 512), limiting_magnitude=1.0, cache=False)


def test_the_stars_of_an_index_are_the_same_from_the_cache(tmp_path: Path, monkeypatch) -> None:
    catalog = load_catalog()
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path))
    settings = index_settings(DEFAULT_CAMERA, catalog, 5.0, 2.0, 12.0)
    expected = resolved_stars(catalog, 5.0, settings.blend_rad)
    for _ in range(2):
        stars = obtain_stars(catalog, settings, cache=True)
        assert len(list(tmp_path.glob("stars-*.npz"))) == 1
        for field in dataclasses.fields(expected):
            np.testing.assert_array_equal(getattr(stars, field.name), getattr(expected, field.name))
