"""The engine is not bound to Linux: it imports no module, and uses no function of `os`, that other systems lack."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import starid

ENGINE = Path(starid.__file__).parent
FILES = [path for path in sorted(ENGINE.rglob("*.py")) if "lab" not in path.relative_to(ENGINE).parts]
ONLY_UNIX = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
"""Modules of the standard library that Windows lacks."""

ONLY_UNIX_OF_OS = {
    "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "fork", "geteuid", "getpgid", "getuid", "killpg", "mkfifo",
    "openpty", "sched_getaffinity", "setsid", "uname",
}  # fmt: skip

GUARDED = {
    ("storage/cache.py", "grp"),
    ("storage/cache.py", "pwd"),
    ("storage/cache.py", "geteuid"),
    ("storage/files.py", "geteuid"),
    ("storage/temporary_folder.py", "fcntl"),
    ("storage/temporary_folder.py", "O_DIRECTORY"),
    ("storage/temporary_folder.py", "O_NOFOLLOW"),
    ("storage/temporary_folder.py", "geteuid"),
    ("storage/working_folder.py", "geteuid"),
}
"""Uses after a test of `sys.platform`: owners of folders and files, and locks."""


def names(tree: ast.AST) -> Iterator[str]:
    """Yield the modules that are imported, and the attributes of `os` that are used."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=imported):
                yield from (each.name.partition(".")[0] for each in imported)
            case ast.ImportFrom(module=str(module)):
                yield module.partition(".")[0]
            case ast.Attribute(value=ast.Name(id="os"), attr=attribute):
                yield attribute


def test_the_engine_uses_nothing_that_only_unix_has() -> None:
    used = {
        (path.relative_to(ENGINE).as_posix(), name)
        for path in FILES
        for name in names(ast.parse(path.read_text(encoding="utf-8")))
        if name in ONLY_UNIX | ONLY_UNIX_OF_OS
    }
    assert ("storage/cache.py", "geteuid") in used
    assert used <= GUARDED
