"""The listed survivors of the mutation run exist: each line still stands in its module, and can change so."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("mutation", ROOT / "tools" / "mutation.py")
mutation = importlib.util.module_from_spec(_SPEC)
sys.modules["mutation"] = mutation
_SPEC.loader.exec_module(mutation)


@pytest.mark.parametrize("module", sorted({module for module, _, _ in mutation.reasons()}))
def test_each_survivor_with_a_reason_is_a_mutant_of_its_line(module):
    path = ROOT / module
    lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
    listed = {(line, change) for name, line, change in mutation.reasons() if name == module}
    nodes = [node for node, _ in mutation.changes(ast.parse(path.read_text("utf-8")))]
    there = [number for number, node in enumerate(nodes) if lines[node.lineno - 1] in dict(listed)]
    mutants = [mutation.mutant(path, number) for number in there]
    assert listed <= {(lines[line - 1], change) for _, line, change in mutants}


@pytest.mark.long
def test_every_change_can_be_made():
    path = ROOT / "protocol" / "serial" / "checks.py"
    source = ast.unparse(ast.parse(path.read_text("utf-8")))
    count = sum(1 for _ in mutation.changes(ast.parse(path.read_text("utf-8"))))
    changed = [ast.unparse(mutation.mutant(path, number)[0]) for number in range(count)]
    assert count > 5
    assert source not in changed
