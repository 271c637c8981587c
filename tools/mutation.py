"""Mutation score: change one operator, number, condition, statement or result at a time, and see whether a test fails.

python tools/mutation.py [GROUP …] [--sample 40] [--seed 1] [--jobs 1]     GROUP: such as protocol/canopen; default: all

Of each group of modules, a random sample of its mutants is tried, each mutant as probable as any other. Only the tests that
execute the changed line run, quickest first, up to 30 s of them; which do is measured first. out/mutation holds each mutant
(mutants.jsonl) and the table (table.md). tests/tools/mutation_survivors.toml holds the reasons of survivors that no test needs
to kill; the exit status is 1 if another one survives.
Each mutant runs in a fork whose functions, or else modules, are exchanged: no file is changed. The tests of each group must pass
so without a change first.
Texts, annotations and log messages are not changed.
"""

from __future__ import annotations

import argparse
import ast
import gc
import json
import os
import random
import resource
import sys
import time
import tomllib
import traceback
import types
from collections.abc import Callable, Iterable, Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OUT = ROOT / "out" / "mutation"
REASONS = ROOT / "tests" / "tools" / "mutation_survivors.toml"
_WIRE = [
    "tests/protocol",
    *(f"--ignore=tests/protocol/{folder}" for folder in ("canopen", "transports")),
    "--ignore=tests/protocol/export",  # its processes need more than MEMORY
]
GROUPS = {
    "emulator/device": [
        "tests/emulator/device",
        "tests/emulator/units",
        "tests/emulator/control/test_upsets.py",
    ],
    "emulator/links": ["tests/emulator/links", "tests/emulator/profile", "tests/emulator/run"],
    "protocol/canopen": ["tests/protocol/canopen", "tests/emulator/links/test_canopen.py"],
    "protocol/can": ["tests/protocol/can", "tests/protocol/transports", "tests/emulator/links"],
    **dict.fromkeys(("protocol/serial", "protocol/icd"), _WIRE),
}
"""Folders of modules, and the tests among which those of a line are found."""
PYTEST = [
    "-q",
    "--assert=plain",  # pytest would load what it rewrites past the mutant
    "-p",
    "no:cacheprovider",
    "-m",
    "not process and not socketcan and not browser",
    "-k",
    "not (mutant or fuzz or conformance or stateful or durand or library or every_unit)",
]
TESTS_S = 30.0
UNJUDGED = 70
"""Exit status of a process that failed before its tests ran."""
MEMORY = 6_000_000_000
_SWAPS = (
    "Lt LtE, Gt GtE, Eq NotEq, Is IsNot, In NotIn, Add Sub, LShift RShift, BitAnd BitOr, And Or, Mult Add, Div Mult, "
    "FloorDiv Mult, Mod Mult, BitXor BitOr"
)
SWAPS: dict[type, type] = {}
for _pair in _SWAPS.split(", "):
    _one, _other = (getattr(ast, name) for name in _pair.split())
    SWAPS.setdefault(_one, _other)
    SWAPS.setdefault(_other, _one)
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
Change = tuple[ast.AST, Callable[[], object]]


def changes(tree: ast.AST) -> Iterator[Change]:
    """Yield every change of a module as its node and a function that makes it in the tree."""
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        note = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        logs = isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("log.", "_log."))
        typing = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for part in [node] if logs or typing else note:
            skipped.update(ast.walk(part) if part is not None else ())
    for node in ast.walk(tree):
        if node not in skipped:
            yield from ((node, change) for change in _changes(node, skipped))


def _changes(node: ast.AST, skipped: set[ast.AST]) -> Iterator[Callable[[], object]]:
    match node:
        case ast.Compare(ops=ops):
            for at, op in enumerate(ops):
                yield lambda at=at, op=op: ops.__setitem__(at, SWAPS[type(op)]())
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            yield lambda: setattr(node, "op", SWAPS[type(op)]())
        case ast.Constant(value=bool() as value):
            yield lambda: setattr(node, "value", not value)
        case ast.Constant(value=int() | float() as value):
            yield lambda: setattr(node, "value", value + 1)
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            yield lambda: setattr(node, "value", ast.Constant(None))
        case ast.Expr(value=ast.Call() as call) if call not in skipped:
            yield lambda: setattr(node, "value", ast.Constant(None))
        case ast.Break() | ast.Continue():
            yield lambda: setattr(
                node, "__class__", ast.Continue if isinstance(node, ast.Break) else ast.Break
            )
        case ast.Call(func=ast.Name(id=name) as func) if name in NAMES:
            yield lambda: setattr(func, "id", NAMES[name])
    for name in ("test", "operand") if isinstance(node, (ast.If, ast.While, ast.IfExp, ast.UnaryOp)) else ():
        if hasattr(node, name) and (name == "test" or isinstance(getattr(node, "op", None), ast.Not)):
            yield lambda name=name: setattr(node, name, ast.UnaryOp(ast.Not(), getattr(node, name)))


def mutant(path: Path, number: int) -> tuple[ast.AST, int, str]:
    """Return a module with one change, its line, and the change as text."""
    tree = ast.parse(path.read_text("utf-8"))
    node, change = list(changes(tree))[number]
    line = node.lineno  # type: ignore[attr-defined] # each has one
    before = ast.unparse(node).splitlines()[0]
    change()
    return (
        ast.fix_missing_locations(tree),
        line,
        f"{before[:70]}  →  {ast.unparse(node).splitlines()[0][:70]}",
    )


class Baseline:
    """Notes which lines each test executes, and how long it takes."""

    def __init__(self, coverage: object) -> None:
        self.coverage, self.seconds = coverage, dict[str, float]()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Begin the lines of a test."""
        self.coverage.switch_context(nodeid)  # type: ignore[attr-defined] # not imported at the top: a fork needs none

    def pytest_runtest_logreport(self, report: object) -> None:
        """Add the time of setup, call or end; a test that fails or is skipped proves nothing."""
        nodeid, passed = report.nodeid, report.passed  # type: ignore[attr-defined]
        self.seconds[nodeid] = self.seconds.get(nodeid, 0.0) + (report.duration if passed else 1e9)  # type: ignore[attr-defined]


def measure(group: str, tests: list[str]) -> None:
    """Run the tests of a group once, and write the tests of each line of each file; "" is what is done before the first."""
    import coverage

    cov = coverage.Coverage(data_file=None, source=[str(ROOT / group)], config_file=False)
    baseline = Baseline(cov)
    cov.start()
    pytest.main([*PYTEST, *tests], plugins=[baseline])
    cov.stop()
    data = cov.get_data()
    lines = {}
    for file in data.measured_files():
        found = data.contexts_by_lineno(file)
        lines[str(Path(file).relative_to(ROOT))] = found
    content = {"seconds": baseline.seconds, "lines": lines}
    (OUT / f"{group.replace('/', '-')}.json").write_text(json.dumps(content), "utf-8")


def tests_of(measured: dict, module: str, line: int) -> list[str]:
    """Return the tests that execute a line, quickest first; those of the whole module for what runs on import."""
    lines = measured["lines"].get(module, {})
    found = set(lines.get(str(line), ())) - {""} or {test for tests in lines.values() for test in tests}
    return quickest(found, measured["seconds"])


def quickest(tests: Iterable[str], seconds: dict[str, float]) -> list[str]:
    """Return the quickest of some tests, as many as take TESTS_S together."""
    selection, spent = [], 0.0
    for test in sorted(seconds.keys() & tests, key=seconds.__getitem__):
        spent += seconds[test]
        if spent > TESTS_S:
            break
        selection.append(test)
    return selection


def change_functions(tree: ast.AST, line: int, module: str) -> bool:
    """Give the loaded functions that contain a line the code of the mutant; return whether there are any."""

    def codes(code: types.CodeType) -> Iterator[types.CodeType]:
        yield code
        for constant in code.co_consts:
            yield from codes(constant) if isinstance(constant, types.CodeType) else ()

    file = str(ROOT / "starhil" / module)
    new = {(code.co_firstlineno, code.co_qualname): code for code in codes(compile(tree, file, "exec"))}
    changed = False
    for function in gc.get_objects():
        if type(function) is types.FunctionType and function.__code__.co_filename == file:
            code = new.get((function.__code__.co_firstlineno, function.__code__.co_qualname))
            lines = {at for each in codes(function.__code__) for _, _, at in each.co_lines()}
            if code is not None and line in lines and code.co_freevars == function.__code__.co_freevars:
                function.__code__ = code
                changed = True
    return changed


def import_again(tree: ast.AST, module: str) -> None:
    """Forget every module of the project and its tests; the mutant is imported in place of its file."""
    for name in [name for name in sys.modules if name.split(".")[0] in ("starhil", "tests")]:
        del sys.modules[name]
    name, original = (
        f"starhil.{module[:-3].replace('/', '.')}".removesuffix(".__init__"),
        SourceFileLoader.get_code,
    )
    SourceFileLoader.get_code = lambda self, full: (
        compile(tree, self.path, "exec") if full == name else original(self, full)
    )


def run(module: str, tree: ast.AST, line: int, tests: list[str], log: Path, *, imported: bool) -> int:
    """Fork a process that runs the tests on a mutant; `imported` is whether its line runs on import. Return its id."""
    child = os.fork()
    if child:
        return child
    os.setpgid(0, 0)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with log.open("wb") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    status = UNJUDGED
    try:
        changed = change_functions(tree, line, module)
        status = pytest.main(["-x", *PYTEST, *tests]) if changed else 0
        if status == 0 and (imported or not changed):
            import_again(tree, module)
            status = pytest.main(["-x", *PYTEST, *tests])
    except BaseException:  # noqa: BLE001 (a fork must not return)
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(status))


def judge(child: int, deadline: float) -> str:
    """Wait for a mutant; return what became of it."""
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code in (
                UNJUDGED,
                pytest.ExitCode.NO_TESTS_COLLECTED,
            ):  # a module that cannot be imported is a usage error
                raise SystemExit(f"the tests could not run; see {OUT}/*.log")
            return "killed" if code else "survived"
        time.sleep(0.02)
    os.killpg(child, 9)
    os.waitpid(child, 0)
    return "killed by time"


def table(results: list[dict]) -> str:
    """Return the table of groups, and the survivors, each with its reason if there is one."""
    lines = [
        "| group | mutants | tried | killed | survived with a reason | without |",
        "|---|---|---|---|---|---|",
    ]
    for group in dict.fromkeys(item["group"] for item in results):
        tried = [item for item in results if item["group"] == group]
        left = [item for item in tried if item["result"] == "survived"]
        killed, reasons = len(tried) - len(left), sum(bool(item["reason"]) for item in left)
        lines.append(
            f"| {group} | {tried[0]['mutants']} | {len(tried)} | {killed} ({100 * killed / len(tried):.0f} %) "
            f"| {reasons} | {len(left) - reasons} |"
        )
    survivors = [
        f"{item['module']}:{item['line']}: {item['change']}: {item['reason'] or 'NO REASON'}"
        for item in results
        if item["result"] == "survived"
    ]
    return "\n".join([*lines, "", *survivors]) + "\n"


def reasons() -> dict[tuple[str, str, str], str]:
    """Return the reason of each survivor that no test needs to kill, by module, text of the line, and change."""
    listed = tomllib.loads(REASONS.read_text("utf-8"))["survivor"]
    return {(item["module"], item["line"], item["change"]): item["reason"] for item in listed}


def in_fork(function: Callable[..., object], *arguments: object) -> None:
    """Call a function in a fork, and wait for it."""
    child = os.fork()
    if not child:
        status = 1
        try:
            function(*arguments)
            status = 0
        except (Exception, SystemExit) as error:  # noqa: BLE001 (a fork must not return)
            print(error)
        finally:
            sys.stdout.flush()
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        sys.exit(1)


def try_group(group: str, tests: list[str], options: argparse.Namespace) -> None:
    """Try the sample of a group, and write what became of each mutant."""
    measured = json.loads((OUT / f"{group.replace('/', '-')}.json").read_text("utf-8"))
    outcomes, running = reasons(), dict[int, dict]()

    def finish(most: int) -> None:
        while len(running) > most:
            child = next(iter(running))
            item = running.pop(child)
            item["result"] = judge(child, item.pop("deadline"))
            text = (ROOT / item["module"]).read_text("utf-8").splitlines()[item["line"] - 1].strip()
            item["reason"] = outcomes.get((item["module"], text, item["change"]), "")
            with (OUT / "mutants.jsonl").open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(item) + "\n")
            print(f"{item['module']}:{item['line']}: {item['result']}: {item['change']}", flush=True)

    pytest.main(["--collect-only", "-qq", *PYTEST[1:], *tests])  # imports everything once
    paths = sorted((ROOT / group).glob("*.py"))
    every = [
        (path, number)
        for path in paths
        for number in range(len(list(changes(ast.parse(path.read_text("utf-8"))))))
    ]
    whole = quickest(measured["seconds"], measured["seconds"])
    unchanged = ast.parse(paths[-1].read_text("utf-8"))
    control = run(str(paths[-1].relative_to(ROOT)), unchanged, 0, whole, OUT / "control.log", imported=True)
    if judge(control, time.monotonic() + 60.0 + 10.0 * TESTS_S) != "survived":
        raise SystemExit(f"{group}: its tests fail without a change; see {OUT}/control.log")
    draw = random.Random(f"{options.seed} {group}")  # noqa: S311 (a sample)
    for path, number in sorted(draw.sample(every, min(options.sample, len(every)))):
        module = str(path.relative_to(ROOT))
        tree, line, change = mutant(path, number)
        covering = tests_of(measured, module, line)
        imported = "" in measured["lines"].get(module, {}).get(str(line), [""])
        finish(options.jobs - 1)
        child = run(
            module, tree, line, covering or ["--version"], OUT / f"{number % 7}.log", imported=imported
        )
        running[child] = {
            "group": group,
            "module": module,
            "mutants": len(every),
            "line": line,
            "change": change,
        }
        running[child]["deadline"] = (
            time.monotonic() + 60.0 + 10.0 * sum(measured["seconds"][test] for test in covering)
        )
    finish(0)


def main() -> None:
    """Try the sample of each group."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("groups", nargs="*", metavar="GROUP", choices=[[], *GROUPS], help="default: all")
    parser.add_argument("--sample", type=int, default=40, help="mutants of each group")
    parser.add_argument("--seed", type=int, default=1, help="seed of the samples")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time")
    parser.add_argument(
        "--baseline", action="store_true", help="measure again which tests execute which line"
    )
    options = parser.parse_args()
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "mutants.jsonl").unlink(missing_ok=True)
    for group in options.groups or GROUPS:
        if options.baseline or not (OUT / f"{group.replace('/', '-')}.json").exists():
            in_fork(measure, group, GROUPS[group])
        in_fork(try_group, group, GROUPS[group], options)
    results = [json.loads(line) for line in (OUT / "mutants.jsonl").read_text("utf-8").splitlines()]
    text = table(results)
    (OUT / "table.md").write_text(text, "utf-8")
    print(text)
    sys.exit(any(item["result"] == "survived" and not item["reason"] for item in results))


if __name__ == "__main__":
    main()
