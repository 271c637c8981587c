"""Orekit, which reads and writes files of attitudes and orbits."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

Orekit = Callable[..., list[Any]]
"""Does what `orekit_files.py` describes; returns the rows."""


@pytest.fixture(scope="package")
def orekit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Orekit]:
    if importlib.util.find_spec("orekit_jpype") is None:
        pytest.skip("the package orekit_jpype is not installed")
    if shutil.which("java") is None:
        pytest.skip("no java here (Debian package default-jre-headless)")
    command = [sys.executable, Path(__file__).with_name("orekit_files.py"), tmp_path_factory.mktemp("orekit")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        lines, answers = process.stdin, process.stdout
        assert lines is not None
        assert answers is not None

        def ask(*arguments: object) -> list[Any]:
            lines.write(json.dumps([*map(str, arguments)]) + "\n")
            lines.flush()
            rows: list[Any] = json.loads(answers.readline())
            return rows

        yield ask
        lines.close()
