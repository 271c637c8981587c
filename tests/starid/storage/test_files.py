"""Files named by the user: reading them, and what is kept when one is overwritten."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.output_file import OutputFile
from starhil.hil_tests.client.wire_log import WireLog
from starid.attitude import Attitude, turn_text
from starid.camera.file import load_camera
from starid.catalog.hipparcos import read_hip2
from starid.cli.output import prepare_output
from starid.errors import StaridError
from starid.identification.thesis.database import DatabaseError
from starid.identification.thesis.database_file import load_database
from starid.imaging.image_io import read_image, write_image
from starid.storage.files import read_bytes, read_number, read_text, write_atomically
from tests.users import OTHER_USER, needs_others
from tests.waiting import PATIENCE_S

READERS: list[tuple[Callable[[Path], object], type[Exception]]] = [
    (read_image, StaridError),
    (load_camera, StaridError),
    (read_hip2, StaridError),
    (load_database, DatabaseError),
]


def test_a_pipe_receives_the_file_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    contents: list[bytes] = []
    holder = os.open(pipe, os.O_RDWR)  # so that neither end waits for the other
    try:
        write_atomically(pipe, lambda part: part.write_bytes(b"whole"))
        contents.append(os.read(holder, 100))
    finally:
        os.close(holder)
    assert contents == [b"whole"]
    assert stat.S_ISFIFO(pipe.lstat().st_mode)


@pytest.mark.parametrize("device", ["/dev/null", "/dev/full"])
def test_a_device_is_written_in_place(tmp_path: Path, device: str) -> None:
    link = tmp_path / "device"
    link.symlink_to(device)
    full = pytest.raises(OSError, match="No space left on device")
    with full if device == "/dev/full" else nullcontext():
        write_atomically(link, lambda part: part.write_bytes(b"whole"))
    assert link.is_symlink()
    assert stat.S_ISCHR(link.stat().st_mode)
    assert list(tmp_path.iterdir()) == [link]


def test_a_link_to_a_file_stays_a_link_and_the_file_is_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "there" / "file", tmp_path / "link"
    link.symlink_to(target)
    write_atomically(link, lambda part: part.write_bytes(b"first"))
    write_atomically(link, lambda part: part.write_bytes(b"second"))
    assert link.is_symlink()
    assert target.read_bytes() == b"second"
    assert list(target.parent.iterdir()) == [target]


@needs_others
@pytest.mark.parametrize("hidden", [False, True], ids=["", "behind an own link"])
def test_a_link_of_another_user_is_not_followed(tmp_path: Path, *, hidden: bool) -> None:
    """In /tmp, it could lead to any file of this user, which was replaced."""
    target, link, own = tmp_path / "precious", tmp_path / "image.png", tmp_path / "own"
    target.write_bytes(b"precious")
    link.symlink_to(target)
    own.symlink_to(link.name)
    os.lchown(link, OTHER_USER, OTHER_USER)
    path = own if hidden else link
    with pytest.raises(PermissionError, match="a link that user 12345 has made"):
        write_atomically(path, lambda part: part.write_bytes(b"whole"))
    with pytest.raises(StaridError, match=r"cannot be written \(a link that user 12345 has made\)"):
        prepare_output(path, "-o")
    with pytest.raises(PermissionError, match="a link that user 12345 has made"):
        WireLog(path)
    assert target.read_bytes() == b"precious"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a link to another user")
@pytest.mark.parametrize("write", [WireLog, lambda path: OutputFile("log", path, overwrite=True)])
def test_a_link_that_another_user_makes_just_before_the_file_is_opened_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], object]
) -> None:
    path, target, lstat = tmp_path / "log", tmp_path / "precious", os.lstat
    target.write_bytes(b"precious")

    def lstat_before_the_link(file: Path) -> os.stat_result:
        try:
            return lstat(file)
        finally:
            if file == path:
                monkeypatch.undo()
                path.symlink_to(target)
                os.lchown(path, 12345, 12345)

    monkeypatch.setattr(os, "lstat", lstat_before_the_link)
    with pytest.raises((OSError, EmulatorError), match="symbolic links"):
        write(path)
    assert path.is_symlink()
    assert target.read_bytes() == b"precious"


@pytest.mark.parametrize("umask", [0o002, 0o022, 0o027, 0o077])
def test_a_new_file_has_the_mode_that_the_umask_leaves_and_a_replaced_one_keeps_its_own(
    tmp_path: Path, umask: int
) -> None:
    """All were readable by everybody, whatever the umask."""
    atomic, log, output, private = (tmp_path / name for name in ("atomic", "log", "output", "private"))
    private.touch(0o600)
    before = os.umask(umask)
    try:
        for path in (atomic, private):
            write_atomically(path, lambda part: part.write_bytes(b"whole"))
        WireLog(log).close()
        OutputFile("log", output).close()
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (atomic, log, output)]
    assert modes == [0o666 & ~umask] * 3
    assert stat.S_IMODE(private.stat().st_mode) == 0o600


def test_a_folder_is_not_overwritten(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        write_atomically(tmp_path, lambda part: part.write_bytes(b"whole"))


@pytest.mark.parametrize("into_file", [False, True])
def test_standard_output_is_written_in_place(tmp_path: Path, *, into_file: bool) -> None:
    program = (
        "import sys; from pathlib import Path; from starid.storage.files import write_atomically;"
        "print('before'); write_atomically(Path(sys.argv[1]), lambda part: part.write_text('whole\\n')); print('after')"
    )
    link, file = tmp_path / "stdout", tmp_path / "file"
    link.symlink_to("/dev/stdout")
    command = [sys.executable, "-c", program, str(link)]
    if into_file:
        with file.open("wb") as stream:
            subprocess.run(command, stdout=stream, check=True, timeout=PATIENCE_S)
        text = file.read_text()
    else:
        text = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, check=True, timeout=PATIENCE_S
        ).stdout
    assert text == "before\nwhole\nafter\n"
    assert link.is_symlink()


def test_a_stream_without_a_suffix_gets_a_png(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    contents: list[bytes] = []
    reader = threading.Thread(target=lambda: contents.append(pipe.read_bytes()), daemon=True)
    reader.start()
    write_image(pipe, np.arange(64, dtype=np.uint8).reshape(8, 8))
    reader.join(timeout=PATIENCE_S)
    assert contents[0].startswith(b"\x89PNG")


READING = """
import importlib, resource, sys
from pathlib import Path

resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
for names in sys.argv[2:]:
    (reader, error_type) = (
        getattr(importlib.import_module(module), name) for module, name in (each.split(":") for each in names.split(","))
    )
    for kind in ("zero", "pipe", "folder"):
        print(reader.__name__, kind, end=": ", flush=True)
        try:
            reader(Path(sys.argv[1]) / kind)
        except error_type as caught:
            print(caught)
"""


@pytest.mark.long
def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """By a process of its own, which may neither wait for a writer nor fill the memory."""
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    names = [",".join(f"{each.__module__}:{each.__name__}" for each in pair) for pair in READERS]
    done = subprocess.run(
        [sys.executable, "-c", READING, str(tmp_path), *names],
        capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    lines = iter(done.stdout.splitlines())
    for reader, _ in READERS:
        for kind in ("zero", "pipe", "folder"):
            line = next(lines, "")
            assert line.startswith(f"{reader.__name__} {kind}: "), done.stdout + done.stderr[-300:]
            assert ("Is a directory" if kind == "folder" else "not a regular file") in line
            assert str(tmp_path / kind) in line
    assert not list(lines)


def test_a_file_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse.png"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(StaridError, match="larger than 1000 MB"):
        read_image(path)
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345"
    with pytest.raises(OSError, match="larger than"):
        read_bytes(path, 4)


def test_a_byte_order_mark_is_not_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_bytes(b"\xef\xbb\xbf[camera]\nwidth = 640\nheight = 480\nfov_deg = 20.0\n")
    assert read_text(path).startswith("[camera]")
    assert load_camera(path).width == 640


@pytest.mark.parametrize("text", ["1_0", "nan", "inf", "-inf", "1e999", "", "x", "١", "0x10", "1,5"])
def test_python_only_notation_is_not_a_number(text: str) -> None:
    with pytest.raises(ValueError, match="not a number"):
        read_number(text)


@pytest.mark.parametrize("form", ["{}x", "0.{}x", ".{}e", "1e{}x", "{}.{}x", "{}e{}", "+{}-", "{}"])
def test_a_long_number_is_read_in_a_time_that_grows_with_its_length(form: str) -> None:
    """A cell of 100 kB in a truth file held the interpreter for a quarter of an hour: a run was unresponsive, also to SIGTERM."""
    text = form.replace("{}", "9" * 50_000)
    begin_s = time.process_time()
    with pytest.raises(ValueError, match="not a number"):
        read_number(text)
    assert time.process_time() - begin_s < 1.0  # the square of the length takes a minute


@pytest.mark.parametrize(("text", "value"), [("1", 1.0), (" -1.5e3 ", -1500.0), (".5", 0.5), ("2.", 2.0)])
def test_numbers_as_other_programs_write_them_are_read(text: str, value: float) -> None:
    assert read_number(text) == value


@pytest.mark.parametrize(
    ("degrees", "said"), [(359.99996, "0.000"), (-1e-17, "0.000"), (359.9994, "359.999"), (360.0, "0.000")]
)
def test_a_formatted_angle_is_below_360_degrees_after_rounding(degrees: float, said: str) -> None:
    assert turn_text(degrees, 3) == said


def test_angles_just_below_a_full_turn_are_shown_as_0() -> None:
    assert str(Attitude.from_radec_roll(-1e-6, 10.0, -1e-6)) == "RA 0.0000° Dec +10.0000° roll 0.0000°"
