"""The version stands once, and whatever repeats it agrees; the long description needs nothing beside it."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[1]


def project_version() -> str:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


def test_the_installed_version_matches_the_project():
    assert importlib.metadata.version("starhil") == project_version()


@pytest.mark.process
@pytest.mark.parametrize("program", ["starhil", "starid"])
def test_the_package_is_run_as_its_command(program):
    done = subprocess.run(
        [sys.executable, "-m", program, "--version"],
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert done.stdout == f"{program} {project_version()}\n"


def test_the_citation_names_the_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", text, re.MULTILINE) == [project_version()]


def test_the_changelog_starts_with_unreleased_and_then_the_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    titles = re.findall(r"^## \[(.*?)\]( - \d{4}-\d\d-\d\d)?$", text, re.MULTILINE)
    assert titles[0] == ("Unreleased", "")
    assert titles[1][0] == project_version()
    assert titles[1][1]


def test_the_long_description_has_no_relative_link_or_image():
    description = importlib.metadata.metadata("starhil").get_payload()
    assert description.startswith("# starhil")
    assert not re.findall(r"\]\((?!https?:)", description)
