"""Files that a run writes, in folders where others write too."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.output_file import OutputFile
from tests.users import OTHER_USER, needs_others


@needs_others
def test_a_link_that_another_user_has_made_is_not_followed(tmp_path: Path) -> None:
    """With --overwrite it emptied any file of the run's user, where the kernel does not protect links."""
    target, link = tmp_path / "precious", tmp_path / "log.csv"
    target.write_bytes(b"precious")
    link.symlink_to(target)
    OutputFile("truth log", link, overwrite=True).close()  # its own link
    target.write_bytes(b"precious")
    os.lchown(link, OTHER_USER, OTHER_USER)
    with pytest.raises(
        EmulatorError,
        match=r"log\.csv: cannot be written \(a link that user 12345 has made\); choose another file",
    ):
        OutputFile("truth log", link, overwrite=True)
    assert target.read_bytes() == b"precious"
