"""Files in the working folder that libraries obey, whoever has put them there."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Final

from starid.errors import StaridError

_OBEYED: Final = {".numba_config.yaml": "numba", "matplotlibrc": "matplotlib"}
"""Name of a file → the library that reads its settings when it is imported: they name files to write and folders of code."""


def check_working_folder() -> None:
    """Check that nobody else has put settings of a library into the working folder, which may be /tmp.

    Raises
    ------
    StaridError
        A file of settings belongs to another user.
    """
    if sys.platform == "win32":
        return
    for name, library in _OBEYED.items():
        try:
            owner = Path(name).lstat().st_uid
        except OSError:  # there is none
            continue
        if owner not in (os.geteuid(), 0):
            raise StaridError(
                f"{Path(name).absolute()}: belongs to user {owner}, and {library} would obey it; change to another folder"
            )
