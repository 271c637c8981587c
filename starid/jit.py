"""Decorators that compile kernels with numba and cache their machine code on disk.

A kernel is loaded, or compiled, when it is first called with arguments of certain types. numba is imported only to
compile (`starid.kernel_library`): machine code in the cache is run without it (`starid.machine_code`), which saves
half a second of a start and 100 MB.

The machine code is in the cache folder (`starid.cache`), in one folder per state of the sources: the module
of the function and every module of the project that it imports, directly or not. Installations with equal
sources share it; if any of these sources changes, the function is compiled again. Each file begins with a
checksum of the rest; a damaged file is removed.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import logging
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterable
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np

from starid.cache import KERNEL_SUFFIX, evict, kernel_folder, mark_used
from starid.files import write_atomically

Kernel = TypeVar("Kernel", bound=Callable[..., object])
Function = Callable[..., Any]

_log = logging.getLogger(__name__)

_IMPORT: Final = re.compile(rb"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)


def compiled(function: Kernel) -> Kernel:
    """Compile a function of numbers and plain arrays, cached on disk and run without the GIL."""
    return cast("Kernel", KernelFunction(function))


def compiled_ieee(function: Kernel) -> Kernel:
    """Compile as `compiled`, with IEEE 754 division (x/0 is infinite or NaN, as in numpy arrays).

    Without numba's test of every divisor a loop over pixels has no branch and is vectorised.
    """
    return cast("Kernel", KernelFunction(function, error_model="numpy"))


def compiled_sums(function: Kernel) -> Kernel:
    """Compile as `compiled_ieee`, but allow sums in any order, so that they are vectorised too."""
    reordered = {"reassoc", "nsz", "contract"}
    return cast("Kernel", KernelFunction(function, error_model="numpy", fastmath=reordered))


def inner(function: Kernel) -> Kernel:
    """Compile a function that only other kernels call, with IEEE 754 division.

    It is optimised and cached only as part of the kernels that call it, and has no wrappers for callers in
    Python and C, which would take longer to compile than the function itself.
    """
    return cast("Kernel", InnerFunction(function, error_model="numpy"))


def inner_checked(function: Kernel) -> Kernel:
    """Compile as `inner`, but division by zero raises an exception, as in `compiled`."""
    return cast("Kernel", InnerFunction(function, error_model="python"))


class InnerFunction:
    """A function that only kernels call.

    Parameters
    ----------
    function : callable
        The Python function.
    options
        Options of numba.

    Attributes
    ----------
    py_func : callable
        The Python function.
    options : dict
    """

    def __init__(self, function: Function, **options: Any) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self.options = options

    def __reduce__(self) -> str:
        """Return the name of the function in its module, for pickling."""
        return self.py_func.__qualname__

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher of the function as a part of the kernels that call it."""
        from starid.kernel_library import inner_dispatcher

        return inner_dispatcher(self.py_func, self.options)

    @property
    def _numba_type_(self) -> Any:
        """Type of the function in other kernels, which numba asks for."""
        return self.dispatcher._numba_type_

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function."""
        return self.dispatcher(*arguments)


class KernelFunction(InnerFunction):
    """A kernel: calls the machine code for the types of its arguments.

    Other kernels that call it contain it, as they do an inner function.

    Attributes
    ----------
    loaded : dict of str to callable
        Machine code loaded or compiled in this process, by the names of the argument types.
    compilations : int
        How many times the kernel was compiled in this process.
    """

    def __init__(self, function: Function, **options: Any) -> None:
        super().__init__(function, **options)
        self.loaded: dict[str, Function] = {}
        self.compilations = 0
        self._by_kind: dict[tuple[object, ...], Function] = {}

    @cached_property
    def entry(self) -> Any:
        """Numba's dispatcher of the kernel as Python calls it."""
        from starid.kernel_library import kernel_dispatcher

        return kernel_dispatcher(self)

    def __call__(self, *arguments: Any) -> Any:
        """Call the machine code for the types of the arguments, which is loaded or compiled the first time."""
        kinds = tuple(
            [(a.dtype, a.ndim, a.flags.num) if type(a) is np.ndarray else _kind(a) for a in arguments]
        )
        function = self._by_kind.get(kinds)
        if function is None:
            function = self._by_kind[kinds] = self.obtain(arguments)
        return function(*arguments)

    def obtain(self, arguments: tuple[Any, ...]) -> Function:
        """Load the machine code for the types of some arguments, or compile it."""
        types = type_names(arguments)
        if types not in self.loaded:
            self.loaded[types] = self._load(types) or self._compile(types, arguments)
        return self.loaded[types]

    def _load(self, types: str) -> Function | None:
        """Load machine code from the cache without numba; None if there is none that can be."""
        from starid.machine_code import NotLoadableError, load

        stored = self.read(types)
        try:
            return None if stored is None else load(stored, self.py_func)
        except NotLoadableError as reason:
            _log.info("%s: loaded by numba: %s", self.py_func.__name__, reason)
            return None

    def _compile(self, types: str, arguments: tuple[Any, ...]) -> Function:
        """Compile the kernel with numba, or let numba load it from the cache."""
        from starid.kernel_library import compile_kernel

        return compile_kernel(self, types, arguments)

    @cached_property
    def _folder(self) -> Path:
        """Folder of the machine code.

        It is in the cache folder, or is ``__pycache__`` beside the source if no cache folder can be made.
        """
        module = self.py_func.__module__
        key = hashlib.sha256(repr((module, source_stamp(module), versions())).encode()).hexdigest()[:16]
        return kernel_folder(key) or Path(self.py_func.__code__.co_filename).parent / "__pycache__"

    def _path(self, types: str) -> Path:
        code = self.py_func.__code__
        key = hashlib.sha256(f"{types} {code.co_firstlineno} {processor()}".encode()).hexdigest()[:16]
        return self._folder / f"{self.py_func.__name__}-{key}{KERNEL_SUFFIX}"

    @property
    def in_cache(self) -> bool:
        """Whether there is cached machine code, for any types."""
        return any(self._folder.glob(f"{self.py_func.__name__}-*{KERNEL_SUFFIX}"))

    def read(self, types: str) -> StoredKernel | None:
        """Return the cached machine code for types of arguments; None if there is none."""
        path = self._path(types)
        content = read_verified(path)
        if content is None:
            return None
        mark_used(path.parent)
        return StoredKernel(*pickle.loads(content))  # noqa: S301 (this package's own cache)

    def write(self, types: str, stored: StoredKernel) -> None:
        """Cache machine code; if it cannot be written, a warning is logged and each process compiles it."""
        path = self._path(types)
        try:
            write_verified(path, pickle.dumps(tuple(stored)))
        except OSError as error:
            _warn_not_kept(path.parent.parent, error.strerror)
        else:
            evict(keep=path.parent)


class BoundKernel:
    """A kernel whose first argument is always the same, so that its type is looked up only once.

    For a tuple of many arrays this takes as long as a tenth of an easy identification.

    Parameters
    ----------
    kernel : callable
        The kernel.
    first
        Its first argument.
    """

    def __init__(self, kernel: Function, first: object) -> None:
        self._kernel = cast("KernelFunction", kernel)
        self._first = first
        self._by_kind: dict[tuple[object, ...], Function] = {}

    def __reduce__(self) -> tuple[type[BoundKernel], tuple[object, ...]]:
        """Return how to make it again, for pickling: machine code belongs to a process."""
        return BoundKernel, (self._kernel, self._first)

    def __call__(self, *others: Any) -> Any:
        """Call the kernel with the first argument and the others."""
        kinds = tuple([(a.dtype, a.ndim, a.flags.num) if type(a) is np.ndarray else _kind(a) for a in others])
        function = self._by_kind.get(kinds)
        if function is None:
            function = self._by_kind[kinds] = self._kernel.obtain((self._first, *others))
        return function(self._first, *others)


class StoredKernel(NamedTuple):
    """Machine code of a kernel in the cache.

    Attributes
    ----------
    code : bytes
        Object file (ELF).
    entry : str
        Name of its function that Python can call.
    environments : list of (str, list)
        Python objects that the code uses, by the name of the variable that refers to them.
    description : bytes
        What numba needs to load it, pickled.
    """

    code: bytes
    entry: str
    environments: list[tuple[str, list[Any]]]
    description: bytes


def _kind(value: Any) -> object:
    """Return a hashable that is equal for two arguments only if machine code for one can be called with the other."""
    if isinstance(value, tuple):
        return (type(value), *map(_kind, value))
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim, value.flags.num
    return type(value)


def type_names(arguments: tuple[Any, ...]) -> str:
    """Return the types of arguments as numba names them, but those of tuples by their members' names."""
    return ", ".join(_type_name(each) for each in arguments)


def _type_name(value: Any) -> str:
    if isinstance(value, np.ndarray):
        flags, dtype = value.flags, value.dtype
        name = dtype.name if dtype.isnative and dtype.kind in "biufc" else repr(dtype)
        if dtype.names:
            name = record_name((field, dtype[field].name) for field in dtype.names)
        layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        return f"{'' if flags.writeable else 'readonly '}array({name}, {value.ndim}d, {layout})"
    if isinstance(value, tuple):
        return f"{type(value).__name__}({type_names(value)})"
    if isinstance(value, (bool, int, float, complex, np.generic)):
        return str(np.dtype(type(value)).name)
    if value is None:
        return "none"
    return "NumPyRandomGeneratorType" if isinstance(value, np.random.Generator) else type(value).__name__


def record_name(fields: Iterable[tuple[str, str]]) -> str:
    """Return the name of a type of record with fields of these names and types."""
    return f"record({', '.join(' '.join(each) for each in fields)})"


@cache
def versions() -> tuple[str, ...]:
    """Versions on which machine code depends: Python, numpy and numba (which is not imported)."""
    place = importlib.util.find_spec("numba")
    folder = Path(cast("str", cast("Any", place).origin)).parent
    numba = hashlib.sha256((folder / "_version.py").read_bytes()).hexdigest()
    return importlib.machinery.EXTENSION_SUFFIXES[0], np.__version__, numba


@cache
def processor() -> str:
    """Describe the processor for which machine code is compiled: its features, and settings of numba."""
    text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").partition("\n\n")[0]
    fixed = ("vendor_id", "cpu family", "model", "flags", "CPU", "Features", "isa")
    lines = [line for line in text.splitlines() if line.startswith(fixed)]
    chosen = [os.environ.get(f"NUMBA_{name}", "") for name in ("CPU_NAME", "CPU_FEATURES", "OPT")]
    return " ".join([*lines, *chosen])


def write_verified(path: Path, content: bytes) -> None:
    """Write a file that begins with the checksum of the rest.

    Raises
    ------
    OSError
        It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda part: part.write_bytes(hashlib.sha256(content).digest() + content))


def read_verified(path: Path) -> bytes | None:
    """Return the content of a file; None if there is none, or if it is damaged, when it is removed."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    if hashlib.sha256(data[size:]).digest() == data[:size]:
        return data[size:]
    _log.info("%s: damaged or of another version, removed; compiled again", path)
    path.unlink(missing_ok=True)
    return None


@cache
def _warn_not_kept(folder: Path, reason: str) -> None:
    """Warn, once per folder and reason, that machine code cannot be cached."""
    _log.warning("%s: machine code cannot be cached (%s): each process compiles it", folder, reason)


@cache
def source_stamp(module: str) -> str:
    """Checksum of a module and of what it imports of its top-level package and `starid`, outside functions.

    Parameters
    ----------
    module : str
        Full name of an imported module.

    Returns
    -------
    str
        Hexadecimal; equal exactly if the sources are.
    """
    digest = hashlib.sha256()
    roots = {"starid", module.partition(".")[0]}
    for name in sorted(_closure(module, roots)):
        digest.update(name.encode() + b"\0" + _source(name) + b"\0")
    return digest.hexdigest()


def _closure(module: str, roots: set[str]) -> set[str]:
    """Names of a module and of all modules that it imports within the root packages."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or not _source(name):
            continue
        found.add(name)
        waiting += [other for other in _imports(name) if other.partition(".")[0] in roots]
    return found


@cache
def _imports(module: str) -> tuple[str, ...]:
    """Names in a module's top-level import statements that may be modules."""
    names = []
    for package, members in _IMPORT.findall(_source(module)):
        names.append(package.decode())
        names += [f"{package.decode()}.{member}" for member in re.findall(r"\w+", members.decode())]
    return tuple(names)


@cache
def _source(module: str) -> bytes:
    """Source of a module; empty if there is none (a class or constant, not a module)."""
    root, *parts = module.split(".")
    home = getattr(sys.modules.get(root), "__file__", None)
    if home is None:
        return b""
    stem = Path(home).parent.joinpath(*parts)
    for path in (stem.with_suffix(".py") if parts else Path(home), stem / "__init__.py"):
        if path.is_file():
            return path.read_bytes()
    return b""
