"""Child processes started by libraries, such as those of a pool."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_SAFE_PATH: Final = "PYTHONSAFEPATH"


@contextmanager
def importing_only_what_is_installed() -> Iterator[None]:
    """Let the Python processes that are started meanwhile import nothing from the working directory.

    Others may have put files there that are named like modules. `multiprocessing` and joblib start their processes, also
    those that watch semaphores, with `-c` or `-m`, which import from that folder first, and they pass on the environment.
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_SAFE_PATH, None)
        else:
            os.environ[_SAFE_PATH] = before
