"""The constraints of the tests with the lowest versions are the floors of `pyproject.toml`."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

import pytest

_PATH = Path(__file__).parents[2] / "tools" / "lowest_versions.py"
_SPEC = importlib.util.spec_from_file_location("lowest_versions", _PATH)
lowest_versions = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(lowest_versions)

PROJECT = tomllib.loads(lowest_versions.PROJECT.read_text(encoding="utf-8"))


def with_dependencies(*dependencies: str) -> dict[str, object]:
    return {"project": {"dependencies": list(dependencies), "optional-dependencies": {"lab": []}}}


def test_every_dependency_has_a_floor() -> None:
    floors = lowest_versions.lowest_versions(PROJECT)
    assert {"numpy", "numba", "opencv-python-headless", "scikit-learn"} <= floors.keys()
    assert len(floors) >= len(PROJECT["project"]["dependencies"])


def test_the_engine_alone_needs_the_same_versions() -> None:
    floors = lowest_versions.lowest_versions(PROJECT)
    engine = (each.split(">=") for each in PROJECT["dependency-groups"]["engine"])
    assert {name: floors[name] for name, _ in engine} == dict(
        each.split(">=") for each in PROJECT["dependency-groups"]["engine"]
    )


@pytest.mark.parametrize("requirement", ["numpy", "numpy==2.0", "numpy>=1.26,<3", "numpy>1.26"])
def test_a_dependency_without_a_plain_floor_is_an_error(requirement: str) -> None:
    with pytest.raises(ValueError, match="must have a floor"):
        lowest_versions.lowest_versions(with_dependencies(requirement))


def test_extras_of_a_dependency_are_no_part_of_its_name() -> None:
    assert lowest_versions.lowest_versions(with_dependencies("dask[distributed]>=2024.1")) == {
        "dask": "2024.1"
    }
