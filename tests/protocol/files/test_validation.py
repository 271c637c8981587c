"""Errors of a document cost no more than its size, and their text is bounded however many there are."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError

from starhil.protocol import errors as names
from starhil.protocol.errors import LONGEST_PROBLEM, MAX_PROBLEMS, ProtocolError
from starhil.protocol.files.validation import problems


class Row(BaseModel):
    """A table."""

    model_config = ConfigDict(extra="forbid")
    value: int
    tables: list[Row] = []


DOCUMENTS: dict[str, Callable[[int], dict[str, Any]]] = {
    "empty tables": lambda count: {"value": 1, "tables": [{}] * count},
    "unknown keys": lambda count: {"value": 1, **{f"valeu{number}": 1 for number in range(count)}},
    "wrong values": lambda count: {"value": 1, "tables": [{"value": "x"}] * count},
    "tables in tables": lambda count: {"value": 1, "tables": [{"value": 1, "tables": [{}] * 10}] * (count // 10)},
}  # fmt: skip


def rejection(document: dict[str, Any]) -> ValidationError:
    with pytest.raises(ValidationError) as caught:
        Row.model_validate(document)
    return caught.value


def calls(function: Callable[[], object]) -> int:
    """Return how many functions, of Python and of C, a call calls."""
    count = 0

    def add(*_event: object) -> None:
        nonlocal count
        count += 1

    sys.setprofile(add)
    try:
        function()
    finally:
        sys.setprofile(None)
    return count


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_the_work_grows_with_the_number_of_errors_and_no_faster(kind: str) -> None:
    def work(count: int) -> int:
        document = DOCUMENTS[kind](count)
        error = rejection(document)
        return calls(lambda: list(problems(error, Row, document)))

    few, many = work(200), work(1600)
    assert many < 10 * few


def test_similar_names_are_sought_for_a_few_errors_only(monkeypatch: pytest.MonkeyPatch) -> None:
    sought = []

    def close(name: str, _known: list[str], **_options: Any) -> list[str]:
        sought.append(name)
        return []

    monkeypatch.setattr("difflib.get_close_matches", close)
    document = DOCUMENTS["unknown keys"](4000)
    assert len(list(problems(rejection(document), Row, document))) == 4000
    assert len(sought) == MAX_PROBLEMS


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_an_error_shows_the_first_problems_and_the_number_of_further_ones(kind: str) -> None:
    document = DOCUMENTS[kind](4000)
    for most in (None, 100):
        error = ProtocolError(*map(str, problems(rejection(document), Row, document, most=most)))
        assert len(error.problems) == MAX_PROBLEMS + 1
        assert error.problems[-1] == "and 3980 more"
        assert str(error).endswith("; and 3980 more")
        assert "" not in error.problems


def test_a_problem_keeps_its_beginning_and_its_remedy() -> None:
    (text,) = ProtocolError(f"name: 'x{'y' * 60_000}' is unknown; give another").problems
    assert len(text) <= LONGEST_PROBLEM + 3
    assert text.startswith("name: 'xyy")
    assert text.endswith("yy' is unknown; give another")


def test_nothing_is_sought_for_a_very_long_name_or_among_very_many(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def close(_name: str, known: list[str], **_options: Any) -> list[str]:
        compared.append(len(known))
        return []

    monkeypatch.setattr("difflib.get_close_matches", close)
    assert names.did_you_mean("a" * 60_000, ["aaa"]) == ""
    known = [f"row_{number}" for number in range(100_000)]
    text = names.remedy("x", known)
    assert compared == [names.MAX_NAMES]
    assert text.endswith(f", and {100_000 - names.MAX_LISTED} more")
    assert text.startswith("; known: row_0, row_1, ")
