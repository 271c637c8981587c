"""Image files: written and read back unchanged; anything else is rejected in one line."""

from __future__ import annotations

import os
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

import starid
from starid.errors import StaridError
from starid.imaging.image_io import read_image, write_image

pytestmark = [pytest.mark.long, pytest.mark.lowest("opencv")]

RNG = np.random.default_rng(8)
GREY8 = RNG.integers(0, 255, (60, 80), dtype=np.uint8)
GREY16 = RNG.integers(0, 65535, (60, 80), dtype=np.uint16)


def written(folder: Path, name: str, pixels: np.ndarray) -> Path:
    assert cv2.imwrite(str(folder / name), pixels)
    return folder / name


@pytest.mark.parametrize("suffix", ["png", "tif", "tiff"])
@pytest.mark.parametrize(("pixels", "bits"), [(GREY8, 8), (GREY16, 16)])
def test_lossless_formats_are_read_back_exactly(
    tmp_path: Path, suffix: str, pixels: np.ndarray, bits: int
) -> None:
    image = read_image(written(tmp_path, f"a.{suffix}", pixels))
    np.testing.assert_array_equal(image, pixels)
    assert 8 * image.itemsize == bits
    assert image.dtype == pixels.dtype


def bmp(bits: int, data: bytes, *, compression: int = 0, palette: bytes = b"", masks: bytes = b"") -> bytes:
    """A BMP of 80×60 pixels with its top row first."""
    start = 54 + len(masks) + len(palette)
    head = struct.pack("<IHHI", start + len(data), 0, 0, start)
    sizes = (40, 80, -60, 1, bits, compression, len(data), 0, 0, len(palette) // 4, 0)
    return b"BM" + head + struct.pack("<IiiHHIIiiII", *sizes) + masks + palette + data


GREY5, GREY6 = (GREY8 >> 3).astype("<u2"), (GREY8 >> 2).astype("<u2")
GREYS = b"".join(bytes([grey] * 3 + [0]) for grey in range(256))
RGB565 = struct.pack("<III", 0xF800, 0x07E0, 0x001F)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (bytes(cv2.imencode(".bmp", GREY8)[1]), 0),
        (bmp(8, GREY8.tobytes(), palette=GREYS), 0),
        (bmp(24, np.dstack([GREY8] * 3).tobytes()), 1),
        (bmp(32, np.dstack([GREY8] * 4).tobytes()), 1),
        (bmp(16, (GREY5 << 10 | GREY5 << 5 | GREY5).tobytes()), 8),
        (bmp(16, (GREY5 << 11 | GREY6 << 5 | GREY5).tobytes(), compression=3, masks=RGB565), 8),
    ],
    ids=["bottom row first", "palette, top row first", "24 bits", "32 bits", "16 bits, 555", "16 bits, 565"],
)
def test_a_bmp_is_read(tmp_path: Path, content: bytes, error: int) -> None:
    (tmp_path / "a.bmp").write_bytes(content)
    image = read_image(tmp_path / "a.bmp", allow_colour=True)
    np.testing.assert_allclose(image.astype(int), GREY8, atol=error)
    assert image.dtype == np.uint8


@pytest.mark.parametrize(
    "content",
    [
        b"BM",
        bmp(24, b"\xff\xd8\xff\xe0", compression=4),
        bmp(64, bytes(8 * GREY8.size)),
        bmp(8, GREY8.tobytes()[:-1], palette=GREYS),
    ],
    ids=["nothing else", "JPEG within", "64 bits", "one byte short"],
)
def test_a_bmp_that_cannot_be_read_is_rejected(tmp_path: Path, capfd, content: bytes) -> None:
    (tmp_path / "a.bmp").write_bytes(content)
    with pytest.raises(StaridError, match=r"a\.bmp: truncated, .* unsupported kind; convert it to PNG$"):
        read_image(tmp_path / "a.bmp")
    assert capfd.readouterr().err == "", "messages of the decoder are suppressed"


def test_jpeg_is_read_back_approximately(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(GREY8, (0, 0), 3)
    image = read_image(written(tmp_path, "a.jpg", smooth))
    assert np.abs(image.astype(int) - smooth).max() <= 8


def test_jpeg_with_trailing_bytes_is_accepted(tmp_path: Path) -> None:
    path = written(tmp_path, "a.jpg", GREY8)
    path.write_bytes(path.read_bytes() + b"appended by a camera")
    assert read_image(path).shape == (60, 80)


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg", "bmp"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.9, 0.999])
def test_truncated_files_are_rejected(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str, share: float
) -> None:
    path = written(tmp_path, f"a.{suffix}", GREY8)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(StaridError, match=rf"a\.{suffix}: truncated(,| or) damaged"):
        read_image(path)
    assert capfd.readouterr().err == "", "messages of the decoder are suppressed"


def test_png_with_a_flipped_bit_is_rejected(tmp_path: Path) -> None:
    path = written(tmp_path, "a.png", GREY8)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(StaridError, match="damaged"):
        read_image(path)


@pytest.mark.parametrize(
    ("name", "pixels", "message"),
    [
        ("c.png", np.dstack([GREY8, GREY8 // 2, GREY8 // 3]), "3 channels"),
        ("c.tif", np.dstack([GREY16] * 3), "3 channels"),
        ("c.png", np.dstack([GREY8] * 4), "4 channels"),
        ("f.tif", GREY8.astype(np.float32), "not float32"),
        ("k.png", np.zeros((9, 9), np.uint8), "all black"),
        ("w.png", np.full((9, 9), 255, np.uint8), "all white"),
        ("w.tif", np.full((9, 9), 65535, np.uint16), "all white"),
        ("g.png", np.full((9, 9), 7, np.uint8), "without any contrast"),
    ],
)
def test_unsuitable_images_are_rejected(tmp_path: Path, name: str, pixels: np.ndarray, message: str) -> None:
    with pytest.raises(StaridError, match=message) as caught:
        read_image(written(tmp_path, name, pixels))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_colour_becomes_luma_when_allowed(tmp_path: Path) -> None:
    blue, green, red = GREY8, GREY8.T.reshape(GREY8.shape), 255 - GREY8
    image = read_image(written(tmp_path, "c.png", np.dstack([blue, green, red])), allow_colour=True)
    expected = 0.114 * blue + 0.587 * green + 0.299 * red
    np.testing.assert_allclose(image, expected, atol=0.5001)
    assert image.dtype == np.uint8


@pytest.mark.parametrize("content", [b"", b"hello", b"GIF89a" + b"\x00" * 50])
def test_other_files_are_rejected(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(StaridError, match=r"PNG, TIFF, JPEG or BMP|is empty"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("large.png", "30000 × 30000 pixels are more than 200 million; crop it, or reduce its size"),
        ("large.bmp", r"cannot be decoded \(.*MAX_IMAGE_PIXELS.*\); crop it, or reduce its size"),
    ],
)
def test_images_that_would_take_the_memory_of_the_machine_are_rejected(
    tmp_path: Path, name: str, message: str
) -> None:
    edge = 30_000 if name.endswith("png") else 40_000
    head = b"IHDR" + struct.pack(">IIBBBBB", edge, edge, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        for chunk in (head, b"IDAT" + zlib.compress(bytes(1000)), b"IEND")
    )
    bmp = struct.pack("<2sIIIIiiHHIIiiII", b"BM", 54, 0, 54, 40, edge, edge, 1, 24, 0, 0, 0, 0, 0, 0)
    (tmp_path / name).write_bytes(png if name.endswith("png") else bmp)
    with pytest.raises(StaridError, match=message):
        read_image(tmp_path / name)


def test_missing_files_and_folders_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(StaridError, match="no such file"):
        read_image(tmp_path / "nothing.png")
    with pytest.raises(StaridError, match="cannot be read"):
        read_image(tmp_path)


@pytest.mark.parametrize("name", ["a.png", "a.tiff", "sub/folder/a.PNG"])
@pytest.mark.parametrize("pixels", [GREY8, GREY16])
def test_a_written_image_is_read_back(tmp_path: Path, name: str, pixels: np.ndarray) -> None:
    write_image(tmp_path / name, pixels)
    np.testing.assert_array_equal(read_image(tmp_path / name), pixels)
    assert [p.name for p in (tmp_path / name).parent.iterdir()] == [Path(name).name]


def test_images_that_cannot_be_written_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(StaridError, match=r"suffix must be .*, not '\.gif'"):
        write_image(tmp_path / "a.gif", GREY8)
    with pytest.raises(StaridError, match="JPEG holds 8 bits"):
        write_image(tmp_path / "a.jpg", GREY16)
    with pytest.raises(StaridError, match="BMP holds 8 bits"):
        write_image(tmp_path / "a.bmp", GREY16)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StaridError, match="cannot be written"):
        write_image(tmp_path / "file" / "a.png", GREY8)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_public_names_are_available_from_the_package() -> None:
    assert starid.Camera.__module__ == "starid.camera.camera"
    assert "load_catalog" in dir(starid)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = starid.nonsense


def png(*chunks: tuple[bytes, bytes], depth: int = 8) -> bytes:
    """A PNG of 8×8 grey pixels with the given chunks between head and end; every checksum is correct."""
    head = struct.pack(">IIBBBBB", 8, 8, depth, 0, 0, 0, 0)
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in ((b"IHDR", head), *chunks, (b"IEND", b""))
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


ROWS = b"".join(b"\0" + bytes(range(row, row + 8)) for row in range(8))
DAMAGED = {
    "short": png((b"IDAT", zlib.compress(ROWS[:20]))),
    "not zlib": png((b"IDAT", b"stars")),
    "filter": png((b"IDAT", zlib.compress(b"\x09" + ROWS[1:]))),
    "depth": png((b"IDAT", zlib.compress(ROWS)), depth=7),
    "no data": png(),
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_png_is_rejected_without_lines_of_the_decoder(content, tmp_path, capfd):
    file = tmp_path / "a.png"
    file.write_bytes(content)
    with pytest.raises(StaridError, match="truncated or damaged"):
        read_image(file)
    assert capfd.readouterr() == ("", "")


def test_a_png_with_a_damaged_optional_chunk_is_read_without_lines_of_the_decoder(tmp_path, capfd):
    file = tmp_path / "a.png"
    file.write_bytes(png((b"gAMA", b"xx"), (b"IDAT", zlib.compress(ROWS))))
    assert read_image(file).tolist()[7] == list(range(7, 15))
    assert capfd.readouterr() == ("", "")


def test_stderr_works_after_images_are_read_in_many_threads_or_without_stderr(tmp_path, capfd):
    file = tmp_path / "a.png"
    file.write_bytes(png((b"IDAT", zlib.compress(ROWS))))
    with ThreadPoolExecutor(8) as threads:
        assert len({image.tobytes() for image in threads.map(read_image, [file] * 200)}) == 1
    os.write(2, b"still here")
    assert capfd.readouterr().err == "still here"
    kept = os.dup(2)
    try:
        os.close(2)
        assert read_image(file).shape == (8, 8)
    finally:
        os.dup2(kept, 2)
        os.close(kept)
