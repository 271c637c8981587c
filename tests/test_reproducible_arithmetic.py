"""What telemetry depends on is computed with functions whose last bit is the same on each machine (`starid.arithmetic.elementary`)."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = (
    "starid/arithmetic", "starid/attitude", "starid/camera", "starid/catalog", "starid/identification", "starid/imaging", "starid/kernels",
    "emulator/device", "emulator/profile", "emulator/sensor", "emulator/simulation", "emulator/truth",
)  # fmt: skip

ELSEWHERE = {
    "starid/camera/calibration.py": "calibration of a camera, before a run",
    "starid/identification/thesis/ablations.py": "an experiment",
    "starid/identification/thesis/matlab_filter.py": "an experiment",
    "starid/identification/thesis/metrics.py": "an experiment",
    "starid/identification/thesis/reference.py": "an experiment",
    "emulator/sensor/pipeline/preview.py": "the image on the console",
    "emulator/truth/ccsds_file.py": "truth of other programs: their frames are turned by SciPy when a file is read",
    "emulator/truth/spice_file.py": "truth of other programs, by SPICE",
    "emulator/truth/standard_frames.py": "truth of other programs: turned by SciPy and `erfa` when a file is read",
}
"""Modules that no sensor uses between truth and telemetry, and why."""

ALLOWED = {
    ("starid/attitude/wahba.py", "np.linalg.svd"): "an estimator that no sensor uses",
    ("starid/catalog/earth.py", "erfa"): "results are put on a grid",
    ("starid/identification/geometric/pattern_index.py", "scipy"): "pairs of stars, no numbers",
    ("starid/identification/thesis/rsi.py", "scipy"): "an experiment",
    ("starid/identification/thesis/frame_motion.py", "np.argsort"): "a kernel: numba's own",
    ("starid/identification/thesis/subcell.py", "np.argsort"): "a kernel: numba's own",
    ("starid/imaging/image_io.py", "**"): "of whole numbers",
    ("emulator/device/quantities.py", "sum"): "of whole numbers",
    ("emulator/sensor/sky/ephemeris.py", "erfa"): "results are put on a grid",
    ("emulator/truth/config.py", "sum"): "of whole numbers",
    ("emulator/truth/orbit.py", "erfa"): "results are put on a grid",
    ("emulator/truth/orbit.py", "sgp4"): "results are put on a grid",
    ("starid/identification/geometric/identifier.py", "sum"): "of whole numbers",
    ("starid/identification/thesis/database_file.py", "sum"): "of whole numbers",
    ("starid/identification/thesis/lsi_identifier.py", "sum"): "of whole numbers",
    ("emulator/sensor/model.py", "**"): "of whole numbers",
}

FUNCTIONS = {
    "acos", "arccos", "acosh", "arccosh", "asin", "arcsin", "asinh", "arcsinh", "atan", "arctan", "atan2", "arctan2", "cbrt",
    "cos", "cosh", "dist", "erf", "erfc", "exp", "exp2", "expm1", "float_power", "gamma", "geomspace", "hypot", "lgamma", "log",
    "log10", "log1p", "log2", "logaddexp", "logspace", "pow", "power", "sin", "sinh", "sumprod", "tan", "tanh",
}  # fmt: skip
"""Of `math` and NumPy: the last bit depends on the C library, the vectors of the processor or the version of Python."""

SUMS = {
    "convolve", "corrcoef", "correlate", "cov", "dot", "einsum", "inner", "interp", "matmul", "polyfit", "polyval", "tensordot",
    "vdot",
}  # fmt: skip
"""Of NumPy: the order of their sums, or whether they fuse multiplication and addition, depends on the processor."""

STABLE = {"'stable'", "'mergesort'"}

LIBRARIES = {"scipy", "erfa", "sgp4", "cmath", "statistics"}


def names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line and name of what is forbidden."""
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id="np" | "math" as module), attr=name):
                if name in FUNCTIONS or (module == "np" and name in SUMS):
                    yield node.lineno, f"{module}.{name}"
            case ast.Attribute(value=ast.Attribute(value=ast.Name(id="np"), attr="linalg" | "fft" as part)):
                yield node.lineno, f"np.{part}.{node.attr}"
            case ast.Attribute(attr="leggauss"):  # eigenvalues by LAPACK
                yield node.lineno, node.attr
            case ast.BinOp(op=ast.MatMult()) | ast.AugAssign(op=ast.MatMult()):
                yield node.lineno, "@"
            case ast.BinOp(
                left=ast.Constant(), op=ast.Pow(), right=ast.Constant() | ast.UnaryOp(operand=ast.Constant())
            ):
                pass  # of whole numbers, or powers of two
            case ast.BinOp(op=ast.Pow()) | ast.AugAssign(op=ast.Pow()):
                yield node.lineno, "**"
            case ast.Call(
                func=ast.Name(id="sum" | "pow" as name)
            ):  # Python 3.12 sums floats with compensation
                yield node.lineno, name
            case ast.Import(names=imported):
                yield from ((node.lineno, each.name.partition(".")[0]) for each in imported)
            case ast.ImportFrom(module=str(module), names=imported):
                yield node.lineno, module.partition(".")[0]
                if module in ("math", "numpy"):
                    yield from ((node.lineno, f"from {module}") for each in imported)
                elif module.endswith("linalg"):
                    yield node.lineno, module


def unstable_orders(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions that sort equal elements in an order that depends on the width of vectors."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id="np"), attr="argsort" | "argpartition" as name),
                keywords=how,
            ):
                if not any(each.arg == "kind" and ast.unparse(each.value) in STABLE for each in how):
                    yield f"np.{name}"


def is_forbidden(name: str) -> bool:
    return name in LIBRARIES or not name.isidentifier() or name in ("sum", "pow", "leggauss")


def uses(file: Path) -> set[tuple[str, str]]:
    path, tree = file.relative_to(ROOT).as_posix(), ast.parse(file.read_text(encoding="utf-8"))
    forbidden = {name for _, name in names(tree) if is_forbidden(name)} | {*unstable_orders(tree)}
    return {(path, name) for name in forbidden}


@pytest.mark.long
def test_telemetry_depends_on_no_function_that_differs_between_machines() -> None:
    files = [file for name in FOLDERS for file in sorted((ROOT / name).rglob("*.py"))]
    assert len(files) > 150
    judged = [file for file in files if file.relative_to(ROOT).as_posix() not in ELSEWHERE]
    assert len(judged) == len(files) - len(ELSEWHERE)
    found = {use for file in judged for use in uses(file)}
    assert sorted(found - set(ALLOWED)) == []
    assert sorted(set(ALLOWED) - found) == []  # what is not used need not be allowed


@pytest.mark.parametrize(
    "text",
    [
        "math.sin(x)", "np.hypot(x, y)", "np.linalg.norm(x)", "a @ b", "x **= 2", "x**2", "10.0**x", "sum(x)", "np.einsum('i->', x)",
        "from scipy.special import expit", "import erfa", "from math import sin", "from numpy import exp",
    ],
)  # fmt: skip
def test_what_differs_is_recognised(text: str) -> None:
    assert [name for _, name in names(ast.parse(text)) if is_forbidden(name)]
