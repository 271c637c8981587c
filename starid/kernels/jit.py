"""Decorators that compile kernels with numba and cache their machine code on disk (`starid.kernels.store`).

A kernel is loaded, or compiled, when it is first called with arguments of certain types. numba is imported only to
compile (`starid.kernels.compiler`): machine code in the cache is run without it (`starid.kernels.machine_code`), which saves
half a second of a start and 100 MB.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cached_property, update_wrapper
from typing import Any, TypeVar, cast

import numpy as np

from starid.kernels.store import KernelStore, record_name

Kernel = TypeVar("Kernel", bound=Callable[..., object])
Function = Callable[..., Any]

_log = logging.getLogger(__name__)


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
        from starid.kernels.compiler import inner_dispatcher

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
    store : KernelStore
        Its machine code on disk.
    """

    def __init__(self, function: Function, **options: Any) -> None:
        super().__init__(function, **options)
        self.loaded: dict[str, Function] = {}
        self.store = KernelStore(function)
        self._by_kind: dict[tuple[object, ...], Function] = {}

    @cached_property
    def entry(self) -> Any:
        """Numba's dispatcher of the kernel as Python calls it."""
        from starid.kernels.compiler import kernel_dispatcher

        return kernel_dispatcher(self.store, self.options)

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
        from starid.kernels.machine_code import NotLoadableError, load

        stored = self.store.read(types)
        try:
            return None if stored is None else load(stored, self.py_func)
        except NotLoadableError as reason:
            _log.info("%s: loaded by numba: %s", self.py_func.__name__, reason)
            return None

    def _compile(self, types: str, arguments: tuple[Any, ...]) -> Function:
        """Compile the kernel with numba, or let numba load it from the cache."""
        from starid.kernels.compiler import compile_kernel

        return compile_kernel(self.entry, types, arguments)


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
