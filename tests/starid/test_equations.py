"""Each equation of the thesis from 2.1 to 6.6 is cited in one docstring, apart from the experiments."""

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
        if "experiments" in path.parts or path.name == "reference.py":
            continue  # these repeat equations of the code that they check
        body = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(body):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                yield f"{path.name}:{node.lineno}", node.value.value


@pytest.fixture(scope="module")
def locations():
    places = defaultdict(list)
    for location, text in docstrings():
        for number in NUMBER.findall(text):
            places[number].append(location)
    return places


@pytest.mark.parametrize("number", PRINTED)
def test_each_equation_is_in_one_docstring(locations, number):
    assert len(locations[number]) == 1, locations[number]
