"""The built wheel in a fresh environment, in a project with folders of the same names."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from tests.process.conftest import NO_IMAGES_TABLES
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "starid": "starid",
    **{name: f"starhil/{name}" for name in ("emulator", "protocol", "hil_tests", "configs")},
}
"""Where the files of each folder are in the wheel."""
QUICK = f'extends = "cubestar"\n{NO_IMAGES_TABLES}'
"""Profile without images: kernels of another installation would be compiled for a minute, as those of the first start."""
OUR_ROOMS = ("emulator", "protocol", "hil_tests", "configs", "tools", "tests")

OBC_TEST = """
import hil_tests, protocol, emulator, configs, tests  # the project's own

def test_the_project_finds_its_own_packages():
    assert {package.OWNER for package in (hil_tests, protocol, emulator, configs, tests)} == {"flight software"}

def test_the_star_tracker_answers(starhil_serial, starhil_can):
    for obc in (starhil_serial, starhil_can):
        assert obc.read("identification")["interface_version"] > 0
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    _run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    )
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def project(wheel, tmp_path_factory) -> Path:
    """A project of flight software, with a separate environment in `.venv`."""
    folder = tmp_path_factory.mktemp("flight_software")
    for name in OUR_ROOMS:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text('OWNER = "flight software"\n')
    (folder / "tests" / "test_obc.py").write_text(OBC_TEST)
    (folder / "quick.toml").write_text(QUICK)
    _install(wheel, folder / ".venv")
    return folder


def _install(wheel: Path, environment: Path) -> None:
    """Install the wheel into a new environment, whose dependencies are links to those of this one.

    To unpack them all again takes minutes on a busy machine.
    """
    venv.create(environment)
    (packages,) = environment.glob("lib/python*/site-packages")
    for installed in Path(sysconfig.get_path("purelib")).iterdir():
        ours = installed.name.lstrip("_").startswith(("starhil", "starid"))
        if not ours and not (packages / installed.name).exists():
            (packages / installed.name).symlink_to(installed)
    pip = [sys.executable, "-m", "pip", "--python", str(environment / "bin/python")]
    _run([*pip, "install", "--quiet", "--no-deps", "--no-compile", str(wheel)])
    _run([*pip, "check"])


def _run(command: list[str], folder: Path | None = None) -> str:
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _starhil(project: Path, *arguments: str) -> str:
    return _run([str(project / ".venv/bin/starhil"), *arguments], project)


def test_the_wheel_brings_two_packages_and_no_more(wheel):
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"starhil", "starid"}


def test_the_wheel_brings_every_file_of_the_packages(wheel):
    with zipfile.ZipFile(wheel) as archive:
        brought = {name for name in archive.namelist() if name.startswith(tuple(PACKAGES.values()))}
    files = {
        f"{target}/{file.relative_to(ROOT / folder).as_posix()}"
        for folder, target in PACKAGES.items()
        for file in (ROOT / folder).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    assert brought == files


def test_plugin_and_fixtures_work_next_to_folders_of_the_same_names(project):
    out = _run(
        [str(project / ".venv/bin/python"), "-m", "pytest", "-q", "--starhil-profile=quick.toml", "tests"],
        project,
    )
    assert "2 passed" in out


def test_a_session_starts_the_emulator_there(project):
    _starhil(project, "session", "parameters", "--start", "--profile", "quick.toml")


def test_conformance_runs_there(project):
    out = _starhil(
        project, "conformance", "serial.framing", "--start", "--profile", "quick.toml", "--serial", "auto"
    )
    assert "0 failed" in out
