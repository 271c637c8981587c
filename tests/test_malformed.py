"""Each reader reports malformed input in the recorded lines, which name the key or line, the problem and the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.malformed import cases, errors_of

pytestmark = pytest.mark.lowest("pydantic")


@pytest.mark.parametrize("case", cases(), ids=lambda case: case["reader"])
def test_a_reader_says_of_malformed_input_what_is_recorded(case: dict, tmp_path: Path) -> None:
    errors = errors_of(case["reader"], case["text"], tmp_path)
    assert errors == case["errors"]
    assert errors
    assert not any("\n" in line for line in errors)
