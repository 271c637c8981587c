"""The stack that the exported C needs: known at compile time, and as small as its page says."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from starhil.protocol.export.c import files, prefix_of
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit

pytestmark = pytest.mark.process
GCC = shutil.which("gcc")
PAGE = Path(__file__).parents[3] / "docs" / "c-export.md"
STATED = re.compile(r"deepest\s+call\s+of\s+any\s+bundled\s+unit\s+takes\s+(\d+)\s+bytes\s+at\s+most")
FUNCTION = re.compile(r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes \((\w+)\)')
CALL = re.compile(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"')


def deepest_call(graph: str) -> int:
    """Return the size of the deepest chain of calls in a graph of `gcc -fcallgraph-info=su`, bytes; calls out of it count nothing."""
    sizes = {name: int(size) for name, size, _ in FUNCTION.findall(graph)}
    callees: dict[str, set[str]] = {}
    for caller, callee in CALL.findall(graph):
        callees.setdefault(caller, set()).add(callee)
    depths: dict[str, int] = {}

    def depth(name: str, callers: tuple[str, ...] = ()) -> int:
        assert name not in callers, f"{name} calls itself"
        if name not in depths:
            inner = [depth(each, (*callers, name)) for each in callees.get(name, ())]
            depths[name] = sizes.get(name, 0) + max(inner, default=0)
        return depths[name]

    return max(depth(name) for name in sizes)


@pytest.mark.skipif(GCC is None, reason="no gcc here: the stack of the exported C is not measured")
@pytest.mark.parametrize("unit", ["cubestar", "sagitta", "st16"])
def test_the_stack_of_the_exported_c_is_known_and_small(unit, tmp_path):
    icd = load_unit(unit)
    for name, text in files(icd, SerialStack(icd)).items():
        (tmp_path / name).write_text(text)
    source = f"{prefix_of(icd)}.c"
    words = [GCC, "-std=c99", "-O2", "-fcallgraph-info=su", "-c", source, "-o", "unit.o"]
    subprocess.run(words, cwd=tmp_path, check=True)
    graph = (tmp_path / "unit.ci").read_text()
    assert {kind for _, _, kind in FUNCTION.findall(graph)} == {"static"}
    (stated,) = STATED.findall(PAGE.read_text(encoding="utf-8"))
    assert deepest_call(graph) <= int(stated)


def test_fields_that_the_same_classes_have_are_read_in_one_condition():
    """cppcheck reports a condition that is the same as the previous one."""
    icd = load_unit("sagitta")
    source = files(icd, SerialStack(icd))["sagitta.c"]
    assert source.count("if ((klass) == 2u) {") == 1
