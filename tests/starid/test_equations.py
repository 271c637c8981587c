"""Every equation that the thesis prints from 2.1 to 6.6 is found by its number in one docstring."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

import starid

NUMBER = re.compile(r"eq\. (\d\.\d+)")
PRINTED = (
    [f"2.{i}" for i in range(1, 38)]
    + [f"3.{i}" for i in range(1, 13)]
    + ["4.1", "4.2", "5.1", "5.2"]
    + [f"6.{i}" for i in range(1, 7)]
)


def docstrings():
    for path in sorted(Path(starid.__file__).parent.rglob("*.py")):
        body = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(body):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                yield f"{path.name}:{node.lineno}", node.value.value


@pytest.fixture(scope="module")
def places():
    found = defaultdict(list)
    for place, text in docstrings():
        for number in NUMBER.findall(text):
            found[number].append(place)
    return found


@pytest.mark.parametrize("number", PRINTED)
def test_equation_stands_in_one_docstring(places, number):
    assert len(places[number]) == 1, places[number]
