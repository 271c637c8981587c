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


def releases() -> tuple[str, list[tuple[str, str]]]:
    """Return the text of [Unreleased] in the changelog, and version and date of the releases, newest first."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    _, unreleased, *others = re.split(r"^## ", text, flags=re.MULTILINE)
    title, _, body = unreleased.partition("\n")
    assert title == "[Unreleased]"
    return body.strip(), [
        re.findall(r"^\[(.*?)\] - (\d{4}-\d\d-\d\d)$", part, re.MULTILINE)[0] for part in others
    ]


def test_a_version_is_a_release_or_in_development_after_it():
    unreleased, ((newest, _), *_) = releases()
    version, _, development = project_version().partition(".dev")
    if development:
        assert [int(part) for part in version.split(".")] > [int(part) for part in newest.split(".")]
    else:
        assert version == newest
        assert not unreleased


def test_the_citation_names_the_newest_release_and_its_date():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    named = [
        re.findall(rf"^{key}: \W?([\d.-]+)\W?$", text, re.MULTILINE) for key in ("version", "date-released")
    ]
    _, (newest, *_) = releases()
    assert named == [[part] for part in newest]


def test_the_long_description_has_no_relative_link_or_image():
    description = importlib.metadata.metadata("starhil").get_payload()
    assert description.startswith("# starhil")
    assert not re.findall(r"\]\((?!https?:)", description)
