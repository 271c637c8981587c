"""Other users, to whom a test gives files: root can, but not in a container that has no other user."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import pytest

OTHER_USER: Final = 12345
THIS_USER: Final = 54321


def _has_others() -> bool:
    ranges = (map(int, line.split()) for line in Path("/proc/self/uid_map").read_text().splitlines())
    return os.geteuid() == 0 and any(first <= OTHER_USER and first + n > THIS_USER for first, _, n in ranges)


HAS_OTHERS: Final = _has_others()

needs_others = pytest.mark.skipif(
    not HAS_OTHERS, reason="only root on a system with several users can give a file to another"
)
