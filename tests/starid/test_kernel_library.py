"""Linking and loading of kernels: inner functions are compiled once, with the kernel that calls them."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numba.core.caching import NullCache

from starid.arrays import Array
from starid.jit import compiled_ieee, inner, inner_checked

LOADED = """
import numpy as np
from starid.projection import project_kernel
from starid.camera import DEFAULT_CAMERA

DEFAULT_CAMERA.project(np.array([[0.0, 0.0, 1.0]]))
(kernel,) = project_kernel.overloads.values()
print(len(list(kernel.library._shared_module.functions)))
print(len(list(kernel.library._get_module_for_linking().functions)) > 0)
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


cast("Any", polynomial)._cache = NullCache()  # compiled in each process, and with it what it calls


@compiled_ieee
def inverse(value: float) -> float:
    return checked_inverse(value)


def test_an_inner_function_called_with_different_constants_is_compiled_once() -> None:
    assert polynomial(np.array([3.0, 0.0])) == 9.0 + 27.0 + 9.0
    kernel: Any = power
    assert len(kernel.overloads) == 1


def test_an_inner_function_has_no_machine_code_of_its_own() -> None:
    polynomial(np.array([1.0]))
    kernel: Any = power
    (overload,) = kernel.overloads.values()
    engine = overload.target_context.codegen()._engine
    assert not engine.is_symbol_defined(overload.fndesc.llvm_func_name)


def test_a_checked_inner_function_raises_for_division_by_zero() -> None:
    assert math.isclose(inverse(4.0), 0.25)
    with pytest.raises(ZeroDivisionError):
        inverse(0.0)


def test_intermediate_code_of_a_loaded_kernel_is_parsed_only_when_it_is_linked(tmp_path: Path) -> None:
    settings = {**os.environ, "STARHIL_CACHE_DIR": str(tmp_path)}
    outputs = [
        subprocess.run(
            [sys.executable, "-c", LOADED], env=settings, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert outputs[1] == ["0", "True"]
