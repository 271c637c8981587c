"""Linking and loading of kernels: inner functions are compiled once, with the kernel that calls them."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

from starid.arrays import Array
from starid.kernels.jit import KernelFunction, compiled, compiled_ieee, inner, inner_checked, type_names
from starid.kernels.machine_code import NotLoadableError, load

WARM = """
import sys
import numpy as np
from starid.camera import DEFAULT_CAMERA

print(DEFAULT_CAMERA.project(np.array([[0.0, 0.0, 1.0]]))[0].tolist(), "llvmlite" in sys.modules)
"""


@inner
def power(base: float, exponent: int) -> float:
    result = 1.0
    for _ in range(exponent):
        result *= base
    return result


@inner_checked
def checked_inverse(value: float) -> float:
    return 1.0 / value


@compiled_ieee
def polynomial(x: Array) -> float:
    return float(power(x[0], 2) + power(x[0], 3) + power(x[0], x.size))


@pytest.fixture(autouse=True, scope="module")
def empty_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Kernels are compiled in this process, and with them what they call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARHIL_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@compiled_ieee
def inverse(value: float) -> float:
    return checked_inverse(value)


def test_an_inner_function_called_with_different_constants_is_compiled_once() -> None:
    assert polynomial(np.array([3.0, 0.0])) == 9.0 + 27.0 + 9.0
    kernel: Any = power
    assert len(kernel.dispatcher.overloads) == 1


def test_an_inner_function_has_no_machine_code_of_its_own() -> None:
    polynomial(np.array([1.0]))
    kernel: Any = power
    (overload,) = kernel.dispatcher.overloads.values()
    engine = overload.target_context.codegen()._engine
    assert not engine.is_symbol_defined(overload.fndesc.llvm_func_name)


def test_a_checked_inner_function_raises_for_division_by_zero() -> None:
    assert math.isclose(inverse(4.0), 0.25)
    with pytest.raises(ZeroDivisionError):
        inverse(0.0)


class Sums(NamedTuple):
    count: int
    values: Array


@compiled_ieee
def table(
    pair: tuple[float, float], size: int, chosen: Sums, generator: np.random.Generator
) -> tuple[Sums, bool]:
    values = np.full(size, pair[0] + power(pair[1], 2)) + chosen.values[0]
    values[0] = generator.random()
    return Sums(chosen.count + size, values), size > 2


@compiled
def checked_root(value: float) -> float:
    if value < 0.0:
        raise ValueError("negative")
    return math.sqrt(value)


ARGUMENTS = ((1.0, 3.0), 4, Sums(7, np.array([0.5])))


def loaded(kernel: Any, *arguments: object) -> Any:
    """The machine code of a kernel from the cache, without numba."""
    kernel(*arguments)
    return load(kernel.store.read(type_names(arguments)), kernel.py_func)


def test_loaded_machine_code_returns_what_numba_returns() -> None:
    expected = table(*ARGUMENTS, np.random.default_rng(3))
    again = loaded(table, *ARGUMENTS, np.random.default_rng(3))(*ARGUMENTS, np.random.default_rng(3))
    assert isinstance(again[0], Sums)
    assert again[0].count == 11
    assert again[1] is expected[1] is True
    assert again[0].values.tobytes() == expected[0].values.tobytes()
    assert again[0].values.flags.writeable


def test_loaded_machine_code_raises_the_exceptions_of_the_kernel() -> None:
    root = loaded(checked_root, 4.0)
    assert root(9.0) == 3.0
    with pytest.raises(ValueError, match="negative"):
        root(-1.0)
    with pytest.raises(ZeroDivisionError):
        loaded(inverse, 4.0)(0.0)


def test_loaded_machine_code_keeps_no_reference_to_its_arguments_or_results() -> None:
    total = loaded(table, *ARGUMENTS, np.random.default_rng(3))
    generator, values = np.random.default_rng(3), np.zeros(1)
    before = sys.getrefcount(values), sys.getrefcount(Sums)
    for _ in range(100):
        total((1.0, 3.0), 4, Sums(7, values), generator)
    assert (sys.getrefcount(values), sys.getrefcount(Sums)) == before


def test_arguments_of_other_types_get_other_machine_code() -> None:
    kernel: Any = last
    readonly = np.arange(3.0)
    readonly.flags.writeable = False
    values = [np.arange(3.0), readonly, np.arange(6.0)[::2], np.arange(3), np.arange(3, dtype=np.float32)]
    assert [kernel(each) for each in values] == [2.0, 2.0, 4.0, 2, 2.0]
    names = ["float64, 1d, C", "float64, 1d, C", "float64, 1d, A", "int64, 1d, C", "float32, 1d, C"]
    assert list(kernel.loaded) == [
        f"{'readonly ' * (row == 1)}array({name})" for row, name in enumerate(names)
    ]
    with pytest.raises(TypeError, match=">f8"):
        kernel(np.arange(3.0).astype(">f8"))


@compiled_ieee
def last(values: Array) -> float:
    return values[-1]


@pytest.mark.parametrize("change", [{"code": b"\x7fELF\x02" + bytes(100)}, {"code": b"MZ" + bytes(100)}])
def test_code_of_another_machine_is_left_to_numba(change: dict[str, Any]) -> None:
    inverse(4.0)
    kernel: Any = inverse
    stored = kernel.store.read("float64")
    with pytest.raises(NotLoadableError):
        load(stored._replace(**change), kernel.py_func)


def test_counts_from_object_files_are_divided_as_integers(monkeypatch: pytest.MonkeyPatch) -> None:
    # NumPy 1 divides a uint64 by an int into a float, which frombuffer rejects
    inverse(4.0)
    kernel: Any = inverse
    counts, read = [], np.frombuffer

    def recorded(buffer: bytes, dtype: Any = float, count: int = -1, offset: int = 0) -> Any:
        counts.append(count)
        return read(buffer, dtype, count, offset)

    monkeypatch.setattr(np, "frombuffer", recorded)
    assert load(kernel.store.read("float64"), kernel.py_func)(8.0) == 0.125
    assert len(counts) > 3
    assert not any(isinstance(count, np.uint64) for count in counts)


def test_numba_loads_what_only_it_can_load(monkeypatch: pytest.MonkeyPatch) -> None:
    def other_machine(*_arguments: object) -> None:
        raise NotLoadableError

    inverse(4.0)
    monkeypatch.setattr("starid.kernels.machine_code.load", other_machine)
    again: Any = KernelFunction(inverse.__wrapped__)  # type: ignore[attr-defined]
    again.options = inverse.options  # type: ignore[attr-defined]
    assert again(4.0) == 0.25
    assert again.store.compilations == 0


def test_a_warm_start_runs_kernels_without_numba() -> None:
    done = subprocess.run([sys.executable, "-c", WARM], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "True", "compiled"
    done = subprocess.run([sys.executable, "-c", WARM], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[[468.0,", "468.0]]", "False"]
