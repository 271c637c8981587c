"""Nothing is read from a cache folder into which others can put files, because kernels run as they are read."""

from __future__ import annotations

import grp
import logging
import os
import pwd
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from starid.storage import cache
from tests.users import HAS_OTHERS, OTHER_USER, THIS_USER, needs_others

USES_IT = """
import os, sys
from starid.storage.cache import cache_dir, cached_tables
os.setgroups([])
os.setgid(0)
os.setuid(int(sys.argv[1]))
cached_tables("stars-0123456789abcdef", dict)
print(cache_dir(), f"{cache_dir().stat().st_mode:o}")
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own temporary folder, as /tmp is: everybody may write to it, and owners only rename."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    for name in ("STARHIL_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    cache._warn_not_used.cache_clear()
    cache._folder_of_process.cache_clear()
    return folder


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user without a home folder and without an entry in the list of users."""

    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)


def test_where_no_temporary_folder_can_be_written_the_chosen_one_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a machine without room on any disk, too."""

    def full() -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", full)
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path))
    assert cache.cache_dir() == tmp_path


def own_folder(temporary: Path) -> Path:
    return temporary / f"starhil-cache-{os.geteuid()}"


def give_away(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a folder belong to another user, or be another user than its owner."""
    if HAS_OTHERS:
        os.chown(folder, OTHER_USER, OTHER_USER)
    elif os.geteuid() == 0:
        pytest.skip("root is the only user here")
    else:
        monkeypatch.setattr(os, "geteuid", lambda: THIS_USER)


@pytest.mark.usefixtures("homeless")
def test_without_a_home_each_user_has_a_private_folder(temporary: Path) -> None:
    folder = cache.cache_dir()
    assert folder == own_folder(temporary)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.usefixtures("homeless")
def test_a_folder_that_another_user_has_put_there_is_not_used(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    planted = own_folder(temporary)
    planted.mkdir(0o755)
    give_away(planted, monkeypatch)
    if os.geteuid() == THIS_USER:
        planted = planted.rename(own_folder(temporary))
    folder = cache.cache_dir()
    assert folder != planted
    assert folder == cache.cache_dir()  # one folder a process
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (warning,) = caplog.records
    assert "belongs to user" in warning.message
    assert "set STARHIL_CACHE_DIR" in warning.message


@needs_others
@pytest.mark.usefixtures("homeless")
def test_a_link_that_another_user_has_put_there_is_not_followed(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "documents").mkdir(0o700)
    link = own_folder(temporary)
    link.symlink_to(tmp_path / "documents")
    os.lchown(link, OTHER_USER, OTHER_USER)
    assert cache.cache_dir() not in (link, tmp_path / "documents")


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o757, 0o775])
@pytest.mark.parametrize("variable", ["STARHIL_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_folder_to_which_others_may_write_is_not_used(
    temporary: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    variable: str,
    mode: int,
) -> None:
    named = tmp_path / "shared"
    folder = named / "starhil" if variable == "XDG_CACHE_HOME" else named
    folder.mkdir(parents=True)
    folder.chmod(mode)
    monkeypatch.setenv(variable, str(named))
    monkeypatch.setattr(pwd, "getpwuid", lambda _user: SimpleNamespace(pw_name="another"))
    assert cache.cache_dir() == own_folder(temporary)
    assert cache.cache_dir() == own_folder(temporary)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]  # once
    assert f"cache folder {folder} is not used: others may write to {folder}" in caplog.text


def test_a_folder_whose_parent_others_may_rename_is_not_used(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "shared"
    (shared / "starhil").mkdir(parents=True, mode=0o700)
    shared.chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared))
    assert cache.cache_dir() == own_folder(temporary)
    shared.chmod(0o1777)  # only owners rename
    assert cache.cache_dir() == shared / "starhil"


def test_a_private_group_of_the_user_may_write(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = tmp_path / "cache"
    named.mkdir()
    named.chmod(0o775)
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(named))
    group = SimpleNamespace(gr_name="ada", gr_mem=[])
    monkeypatch.setattr(pwd, "getpwuid", lambda _user: SimpleNamespace(pw_name="ada"))
    monkeypatch.setattr(grp, "getgrgid", lambda _group: group)
    if os.geteuid() == 0:
        assert cache.cache_dir() == own_folder(temporary)  # group 0: every user of a container may be in it
        if not HAS_OTHERS:
            return
        os.chown(named, -1, OTHER_USER)
    assert cache.cache_dir() == named
    group.gr_mem.append("mallory")
    assert cache.cache_dir() == own_folder(temporary)


def test_a_read_only_cache_of_root_is_used(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "STARHIL_CACHE_DIR", "/usr"
    )  # of root in every system, and nobody else may write to it
    assert cache.cache_dir() == Path("/usr")
    assert not list(temporary.iterdir())


def test_kernels_in_a_folder_to_which_others_may_write_are_not_used(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = "0123456789abcdef"
    folder = tmp_path / "cache" / "kernels" / key
    folder.mkdir(parents=True)
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "cache"))
    assert cache.kernel_folder(key) == folder
    folder.chmod(0o777)
    assert cache.kernel_folder(key) != folder


@pytest.mark.parametrize("mode", [0o666, 0o777])
def test_kernels_to_which_others_may_write_are_not_used_whatever_the_folder_above(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int
) -> None:
    """A process whose umask lets others write had made the folder of a module, or a kernel."""
    key = "0123456789abcdef"
    folder = tmp_path / "cache" / "kernels" / key
    kernel = folder / "module" / "kernel.nbc"
    kernel.parent.mkdir(parents=True)
    kernel.write_bytes(b"code")
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "cache"))
    assert cache.kernel_folder(key) == folder
    (kernel if mode == 0o666 else kernel.parent).chmod(mode)
    assert cache.kernel_folder(key) != folder
    folder.chmod(0o700)  # nobody else may enter it
    assert cache.kernel_folder(key) == folder


@needs_others
def test_a_container_with_a_random_user_does_not_use_what_another_has_left() -> None:
    with tempfile.TemporaryDirectory() as shared:
        Path(shared).chmod(0o1777)
        environment = {"PATH": os.environ["PATH"], "TMPDIR": shared, "STARHIL_CACHE_DIR": ""}
        folders = [
            subprocess.run(
                [sys.executable, "-c", USES_IT, str(user)],
                env=environment, capture_output=True, text=True, check=True,
            ).stdout.split()
            for user in (OTHER_USER, THIS_USER)
        ]  # fmt: skip
    assert folders == [[f"{shared}/starhil-cache-{user}", "40700"] for user in (OTHER_USER, THIS_USER)]
