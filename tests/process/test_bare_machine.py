"""A machine that lacks what is usual, such as /dev/shm in a container: what cannot work says so in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.process.conftest import NO_IMAGES_OPTIONS
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
BARE_DEV = """
mount -t tmpfs tmpfs /mnt
for name in null zero random urandom; do touch /mnt/$name; mount --bind /dev/$name /mnt/$name; done
mount --rbind /mnt /dev
exec "$@"
"""
"""Runs a command on a machine with the simplest devices only: no /dev/shm, no /dev/pts, no /dev/ptmx."""


def starhil(*words: str, before: tuple[str, ...] = (), **environment: str) -> tuple[int, str]:
    """Run the command; return its exit status and what it wrote on stderr."""
    done = subprocess.run(
        [*before, str(Path(sys.executable).with_name("starhil")), *words],
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.fixture(scope="module")
def bare_dev():
    """Words before a command that give it an empty /dev."""
    words = ("unshare", "--map-root-user", "--mount", "sh", "-e", "-c", BARE_DEV, "sh")
    try:
        subprocess.run([*words, "true"], check=True, capture_output=True, timeout=PATIENCE_S)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this user may not make a mount namespace (unshare)")
    return words


def test_endurance_without_dev_shm_names_it(bare_dev):
    assert starhil("endurance", "--lives", "1", "--steps", "5", before=bare_dev) == (
        2,
        (
            "starhil: endurance: its processes need POSIX semaphores, which are not available "
            "(No such file or directory): mount a tmpfs on /dev/shm\n"
        ),
    )


def test_a_pty_without_dev_pts_names_the_way_out(bare_dev):
    assert starhil("run", "--can", "off", *NO_IMAGES_OPTIONS, before=bare_dev) == (
        2,
        (
            "starhil: serial pty: no pseudo-terminal is available (No such file or directory): "
            "mount devpts on /dev/pts, name a serial port, or do without it (--serial off)\n"
        ),
    )


@pytest.mark.parametrize("command", ["render --ra 80 --dec 0 --size 64 -o x.png", "run --can off"])
def test_kernels_that_numba_is_forbidden_to_compile_are_named(command, tmp_path):
    status, errors = starhil(*command.split(), NUMBA_DISABLE_JIT="1", STARHIL_CACHE_DIR=str(tmp_path))
    assert (status, errors) == (
        2,
        "starhil: NUMBA_DISABLE_JIT is set: images are only made and solved by compiled kernels; unset it\n",
    )


def test_a_virtual_environment_that_could_not_be_made_is_made_again(tmp_path):
    python = tmp_path / "python3"
    python.write_text(
        "#!/bin/sh\n[ $1 = -c ] && exit\nmkdir -p .venv && echo home >.venv/pyvenv.cfg\n"
        "echo 'ensurepip is not available'\nexit 1\n"
    )
    python.chmod(0o755)
    make = ["make", "-C", str(tmp_path), "-f", str(ROOT / "Makefile"), f"PYTHON={python}", ".venv/pyvenv.cfg"]
    for _ in range(2):
        done = subprocess.run(make, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert (done.returncode, "ensurepip is not available" in done.stdout) == (2, True)


ON_32_BITS = "import sys; sys.maxsize = 2**31 - 1; "


@pytest.mark.parametrize("module", ["starhil.emulator.cli", "starid.cli"])
def test_a_32_bit_system_is_named_by_the_commands(module):
    done = subprocess.run(
        [sys.executable, "-c", f"{ON_32_BITS} from {module} import main; main()"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    name = module.partition(".")[0]
    assert (done.returncode, done.stderr) == (1, f"{name}: needs a 64-bit system: x86-64 or arm64\n")


def test_a_32_bit_system_is_named_by_make(tmp_path):
    python = tmp_path / "python3"
    python.write_text(f'#!/bin/sh\n[ $1 = -c ] && exec {sys.executable} -c "{ON_32_BITS} $2"\ntouch "$3"\n')
    python.chmod(0o755)
    make = ["make", "-C", str(tmp_path), "-f", str(ROOT / "Makefile"), f"PYTHON={python}", ".venv/pyvenv.cfg"]
    done = subprocess.run(make, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[0] == "starhil needs a 64-bit system: x86-64 or arm64"
    assert not (tmp_path / ".venv").exists()
