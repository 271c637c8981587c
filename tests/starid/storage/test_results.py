"""Results of long computations on disk: what is damaged or was made by others ends in one line, and is not waited for."""

import io
import os
import struct
import zipfile

import numpy as np
import pytest

from starid.errors import StaridError
from starid.storage.results import PLAN_FILE, ResultStore


def array_file(header):
    """A .npy file with a header and no values."""
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text


def archive(name, content):
    """A .npz file with one member."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as written:
        written.writestr(name, content)
    return stream.getvalue()


def changed(content, local, central, value):
    """An archive with another field of two bytes in both headers of its first member."""
    result = bytearray(content)
    directory = content.index(b"PK\x01\x02")
    result[local : local + 2] = result[directory + central : directory + central + 2] = struct.pack(
        "<H", value
    )
    return bytes(result)


WHOLE = archive("a.npy", array_file("{'descr': '<f8', 'fortran_order': False, 'shape': (0,)}"))
HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (%d,)}"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"text",
        array_file("{'descr': '<f8', 'fortran_order': False, 'shape': (0,)}"),
        archive("a.npy", array_file(HUGE % 10**13)),
        archive("a.npy", array_file(HUGE % 10**30)),
        archive("a.npy", array_file("(((((")),
        archive("a", b"no array"),
        changed(WHOLE, 8, 10, 99),  # a compression that does not exist
        changed(WHOLE, 6, 8, 1),  # encrypted
    ],
    ids=["empty", "text", "npy", "huge", "overflow", "header", "bytes", "compression", "encrypted"],
)
def test_a_damaged_part_is_an_error_of_one_line(tmp_path, content):
    store = ResultStore(tmp_path, {"frames": 1}, "campaign")
    store.save("part", {"rows": np.arange(3)})
    store.file("part").write_bytes(content)
    with pytest.raises(StaridError, match=r"campaign: .*part\.npz .*remove it to compute it again"):
        store.load("part")


def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(tmp_path):
    store = ResultStore(tmp_path, {"frames": 1}, "campaign")
    os.mkfifo(store.file("part"))
    with pytest.raises(StaridError, match="not a regular file"):
        store.load("part")
    (tmp_path / PLAN_FILE).unlink()
    os.mkfifo(tmp_path / PLAN_FILE)
    with pytest.raises(StaridError, match="not a regular file"):
        ResultStore(tmp_path, {"frames": 1}, "campaign")
