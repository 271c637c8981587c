"""Machine code of a kernel, loaded from an object file (ELF, x86-64) and called without numba.

LLVM makes code that may lie anywhere: each address in it is an absolute one of 64 bits, or, in a few places, the
distance from where it stands. So it is loaded by copying its sections into memory, filling in the addresses, and
making the memory executable. The code takes and returns Python objects with functions of three extension modules
of numba, which are loaded without the package.
"""

from __future__ import annotations

import builtins
import ctypes
import importlib.machinery
import importlib.util
import mmap
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from starid.kernels.store import StoredKernel

_HEADER: Final = np.dtype(
    {
        "names": ["machine", "sections", "count"],
        "formats": ["<u2", "<u8", "<u2"],
        "offsets": [18, 40, 60],
        "itemsize": 64,
    }
)
_SECTION: Final = np.dtype(
    [
        ("name", "<u4"),
        ("type", "<u4"),
        ("flags", "<u8"),
        ("address", "<u8"),
        ("offset", "<u8"),
        ("size", "<u8"),
        ("link", "<u4"),
        ("info", "<u4"),
        ("align", "<u8"),
        ("entry", "<u8"),
    ]
)
_SYMBOL: Final = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)
_RELOCATION: Final = np.dtype([("offset", "<u8"), ("type", "<u4"), ("symbol", "<u4"), ("addend", "<i8")])

_X86_64: Final = 62
_PROGBITS, _SYMTAB, _RELA, _UNWIND = 1, 2, 4, 0x70000001
_WRITE, _ALLOC = 1, 2
_UNDEFINED, _COMMON, _RESERVED = 0, 0xFFF2, 0xFF00
_ADDRESS, _DISTANCE = 1, 24
_READ_AND_EXECUTE: Final = 5

_kept: Final[list[object]] = []
"""Memory and objects of loaded code, which stay for the life of the process."""


class NotLoadableError(Exception):
    """The code is of another machine, or uses something that only numba can provide."""


def load(stored: StoredKernel, function: Callable[..., Any]) -> Callable[..., Any]:
    """Load a kernel's machine code; return a function that Python can call.

    Raises
    ------
    NotLoadableError
        Only numba can load it.
    """
    addresses = _load_object(stored.code)
    helpers = _extension("_dynfunc")
    own = None
    for name, constants in stored.environments:
        environment = helpers.Environment(function.__globals__)
        environment.consts[:] = constants
        _kept.append(environment)
        ctypes.c_void_p.from_address(addresses[name]).value = id(environment)
        own = own or environment
    module, doc = sys.modules[function.__module__], function.__doc__ or ""
    made = helpers.make_function(module, function.__name__, doc, addresses[stored.entry], own, ())
    return cast("Callable[..., Any]", made)


def _load_object(code: bytes) -> dict[str, int]:
    """Load an object file; return the addresses of its symbols."""
    head = np.frombuffer(code, _HEADER, 1)[0]
    if code[:5] != b"\x7fELF\x02" or head["machine"] != _X86_64 or sys.platform != "linux":
        raise NotLoadableError("not code of Linux on x86-64")
    sections = np.frombuffer(code, _SECTION, head["count"], head["sections"])
    (table,) = sections[sections["type"] == _SYMTAB]
    symbols = np.frombuffer(code, _SYMBOL, int(table["size"]) // _SYMBOL.itemsize, table["offset"])
    texts = sections[table["link"]]
    names = [_text(code, int(texts["offset"] + each)) for each in symbols["name"]]
    loaded = (sections["flags"] & _ALLOC != 0) & (sections["type"] != _UNWIND)
    if np.any(sections["type"][loaded] != _PROGBITS) or np.any(sections["flags"][loaded] & _WRITE):
        raise NotLoadableError("sections other than code and constants")

    end, starts = 0, np.zeros(len(sections), dtype=np.uint64)
    for number in np.flatnonzero(loaded):
        starts[number] = end = _aligned(end, int(sections["align"][number]))
        end += int(sections["size"][number])
    variables = _aligned(end, mmap.PAGESIZE)
    common = np.flatnonzero(symbols["section"] == _COMMON)
    memory = mmap.mmap(-1, variables + 16 * len(common) + mmap.PAGESIZE)
    _kept.append(memory)
    base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    for number in np.flatnonzero(loaded):
        offset, size, start = (int(each) for each in (*sections[["offset", "size"]][number], starts[number]))
        memory[start : start + size] = code[offset : offset + size]

    inside = symbols["section"] < _RESERVED
    addresses = symbols["value"].copy()
    addresses[inside] += starts[symbols["section"][inside]] + np.uint64(base)
    addresses[common] = base + variables + 16 * np.arange(len(common))
    for number in np.flatnonzero(symbols["section"] == _UNDEFINED)[1:]:
        addresses[number] = _address(names[number])
    for section in sections[sections["type"] == _RELA]:
        if loaded[section["info"]]:
            _relocate(memory, base, int(starts[section["info"]]), addresses, code, section)
    if ctypes.CDLL(None).mprotect(ctypes.c_void_p(base), ctypes.c_size_t(variables), _READ_AND_EXECUTE) != 0:
        raise NotLoadableError("memory cannot be made executable")
    return dict(zip(names, addresses.tolist(), strict=True))


def _relocate(
    memory: mmap.mmap, base: int, start: int, addresses: NDArray[np.uint64], code: bytes, section: Any
) -> None:
    """Fill in the addresses in one section, which begins at `start`."""
    entries = np.frombuffer(
        code, _RELOCATION, int(section["size"]) // _RELOCATION.itemsize, section["offset"]
    )
    if not np.isin(entries["type"], (_ADDRESS, _DISTANCE)).all():
        raise NotLoadableError(f"relocations of types {sorted(set(entries['type'].tolist()))}")
    places = entries["offset"] + np.uint64(start)
    values = addresses[entries["symbol"]] + entries["addend"].view(np.uint64)
    values -= np.where(entries["type"] == _DISTANCE, places + np.uint64(base), np.uint64(0))
    content = np.frombuffer(memory, np.uint8)
    content[places[:, None] + np.arange(8, dtype=np.uint64)] = values.view(np.uint8).reshape(-1, 8)


def _aligned(offset: int, step: int) -> int:
    return -(-offset // max(step, 1)) * max(step, 1)


def _text(code: bytes, offset: int) -> str:
    return code[offset : code.index(b"\0", offset)].decode()


@cache
def _address(name: str) -> int:
    """Return the address of a function or object that machine code refers to, as numba would."""
    helpers = _extension("_helperlib").c_helpers
    runtime = _extension("core.runtime._nrt_python").c_helpers
    if name == "_Py_NoneStruct":
        return id(None)
    if name.startswith("PyExc_"):
        return id(getattr(builtins, name.removeprefix("PyExc_")))
    found = (
        helpers.get(name.removeprefix("numba_"))
        or runtime.get(name)
        or runtime.get(name.removeprefix("NRT_"))
    )
    if found is not None:
        return int(found)
    try:
        return ctypes.cast(getattr(ctypes.CDLL(None), name), ctypes.c_void_p).value or 0
    except AttributeError:
        raise NotLoadableError(f"unknown symbol {name}") from None


@cache
def _extension(name: str) -> Any:
    """Return an extension module of numba without importing numba itself."""
    whole = f"numba.{name}"
    if whole in sys.modules:
        return sys.modules[whole]
    place = cast("Any", importlib.util.find_spec("numba"))
    path = Path(place.origin).parent.joinpath(*name.split("."))
    path = path.with_name(path.name + importlib.machinery.EXTENSION_SUFFIXES[0])
    spec = cast("Any", importlib.util.spec_from_file_location(whole, path))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
