"""How many of the kernels that a process compiles are in the cache, seen from a process that imports none of them."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from starid.kernels.kernel_cache import kernels_key
from starid.storage.cache import kernel_folder

_IMPORT: Final = re.compile(r"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)
_KERNEL: Final = re.compile(r"^@compiled\w*\ndef (\w+)", re.MULTILINE)
_TOPS: Final = ("starid", "starhil")


class CompileProgress:
    """The kernels of some modules and of all that they import when they are loaded."""

    def __init__(self, modules: Iterable[str]) -> None:
        self.kernels: Final = kernels_of(modules)
        """Names as numba gives them to their files: `module.function`."""
        self._folder: Final = kernel_folder(kernels_key())

    def compiled(self) -> int:
        """Return how many are in the cache."""
        files = () if self._folder is None else self._folder.glob("*/*.nbi")
        return len(self.kernels & {path.name.partition("-")[0] for path in files})


def kernels_of(modules: Iterable[str]) -> frozenset[str]:
    """Return `module.function` of each kernel of some modules and of those that they import, directly or not."""
    waiting, seen, kernels = list(modules), set[str](), set[str]()
    while waiting:
        module = waiting.pop()
        path = None if module in seen else _file_of(module)
        seen.add(module)
        if path is None:
            continue
        source = path.read_text(encoding="utf-8")
        kernels |= {f"{path.stem}.{function}" for function in _KERNEL.findall(source)}
        for package, members in _IMPORT.findall(source):
            waiting += [package, *(f"{package}.{member}" for member in re.findall(r"\w+", members))]
    return frozenset(kernels)


def _file_of(module: str) -> Path | None:
    """Return the file of a module of this project; None if it has none."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top) if top in _TOPS else None
    for home in (spec.submodule_search_locations if spec else None) or ():
        stem = Path(home).joinpath(*rest)
        for path in (stem.with_suffix(".py"), stem / "__init__.py"):
            if path.is_file():
                return path
    return None
