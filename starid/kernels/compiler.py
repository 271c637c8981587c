"""How numba compiles kernels; imported only where one is compiled.

numba optimises every function, with all that it calls, and turns it into machine code, before it links it into
its callers, where both happen again. Here, a function that a kernel calls is left as it is until the kernel is
optimised as a whole: only a kernel that Python calls becomes machine code.
"""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple, cast

from numba import njit
from numba.core import codegen, serialize, sigutils, types
from numba.core.callwrapper import PyCallWrapper
from numba.core.compiler import CompilerBase, CompileResult, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering

from starid.kernels.store import KernelStore, StoredKernel, record_name

_njit: Any = njit
_codegen: Any = codegen
_llvm: Any = _codegen.ll
_types: Any = types
_Library: Any = _codegen.JITCodeLibrary
_Lowering: Any = NativeLowering
_Compiler: Any = CompilerBase
_PassBuilder: Any = DefaultPassBuilder
_PassManager: Any = PassManager
_register_pass: Any = register_pass
_Wrapper: Any = PyCallWrapper
_CompileResult: Any = CompileResult
_normalize_signature: Any = sigutils.normalize_signature
_dumps: Any = serialize.dumps

_NO_CODE: Final[bytes] = _llvm.parse_assembly("").as_bitcode()


def _import_numba_arrays() -> None:
    """Import numba's array support without importing all of ``scipy.linalg``.

    numba imports ``scipy.linalg`` only to check that it exists. scipy is a requirement of this package; a kernel that multiplies matrices
    imports what it needs when it is called.
    """
    linalg: Any = importlib.import_module("numba.np.linalg")
    ensure_blas = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = ensure_blas


_import_numba_arrays()


def _keep_classes_in_environments() -> None:
    """Let a kernel find the classes of its results in its environment, instead of unpickling them in each call.

    Unpickling imports numba, and takes a microsecond for each array that a kernel returns.
    """
    get_environment = _Wrapper.get_env

    def get_env(wrapper: Any, api: Any, builder: Any) -> Any:
        manager = get_environment(wrapper, api, builder)
        unserialize = api.unserialize

        def from_environment(value: Any) -> Any:
            if not isinstance(value, _InEnvironment):
                return unserialize(value)
            found = manager.read_const(manager.add_const(value.constant))
            api.incref(found)  # as after unpickling
            return found

        api.serialize_object, api.unserialize = _InEnvironment, from_environment
        return manager

    _Wrapper.get_env = get_env


class _InEnvironment(NamedTuple):
    """A Python object that a wrapper takes from the environment of its kernel."""

    constant: Any


_keep_classes_in_environments()


class InnerLibrary(_Library):  # type: ignore[misc]
    """Intermediate code of an inner function and of those that it calls, neither optimised nor executable."""

    @property
    def codegen(self) -> InnerLibrary:
        """The owner of the function's environment: nobody, because only code that calls Python reads it."""
        return self

    def set_env(self, _name: str, _environment: object) -> None:
        """Do nothing: there is no machine code that could refer to an environment."""

    def get_pointer_to_function(self, _name: str) -> int:
        """Return 0, as numba does for a function without machine code."""
        return 0

    def finalize(self) -> None:
        """Link the functions that this one calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)  # noqa: SLF001
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)  # noqa: SLF001
        self._finalize_dynamic_globals()
        self._finalized = True


@_register_pass(mutates_CFG=True, analysis_only=False)
class InnerLowering(_Lowering):  # type: ignore[misc]
    """numba's lowering, into an `InnerLibrary`."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a function.

        Raises
        ------
        NotImplementedError
            The function uses Python objects, for which its environment would be needed.
        """
        state.library = InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        super().run_pass(state)
        if state["cr"].env.consts:
            raise NotImplementedError(f"{state.func_id.func_qualname}: an inner function with Python objects")
        return True


class InnerCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler, with `InnerLowering`."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes for nopython mode, the lowering replaced."""
        passes = _PassBuilder.define_nopython_pipeline(self.state).passes
        manager = _PassManager("inner")
        manager.passes = [(InnerLowering if each is NativeLowering else each, why) for each, why in passes]
        manager.finalize()
        return [manager]


def without_literals(dispatcher: Any) -> Any:
    """Let calls with different integer constants use one compilation of a function."""
    template = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, keywords: template(
        [_types.unliteral(each) for each in args],
        {name: _types.unliteral(each) for name, each in keywords.items()},
    )
    return dispatcher


class KernelCache:
    """The disk cache of one kernel, as numba uses it: to write it, and to load what `starid.kernels.machine_code` cannot."""

    def __init__(self, store: KernelStore) -> None:
        self._store = store

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return a cached kernel, or None."""
        target_context.refresh()
        arguments, _ = _normalize_signature(signature)
        stored = self._store.read(names_of_types(arguments))
        if stored is None:
            return None
        name, description, *rest = pickle.loads(stored.description)  # noqa: S301 (this package's own cache)
        names = ("llvm_func_name", "llvm_cpython_wrapper_name")
        engine = target_context.codegen()._engine  # noqa: SLF001
        engine._defined_symbols.update(getattr(description, each) for each in names)  # noqa: SLF001
        library = name, "object", (stored.code, _NO_CODE)
        return _CompileResult._rebuild(target_context, library, description, *rest)  # noqa: SLF001

    def save_overload(self, _signature: Any, kernel: Any) -> None:
        """Cache a kernel that was compiled."""
        self._store.compilations += 1
        if kernel.library.has_dynamic_globals or kernel.reload_init:
            return  # refers to objects of this process
        (name, _, (code, _)), description, *rest = kernel._reduce()  # noqa: SLF001
        used = {each.env_name: each.consts for each in rest[-1] if each.consts}
        used = {kernel.environment.env_name: kernel.environment.consts, **used}
        stored = StoredKernel(
            code,
            description.llvm_cpython_wrapper_name,
            list(used.items()),
            _dumps((name, description, *rest)),
        )
        self._store.write(names_of_types(description.argtypes), stored)


def inner_dispatcher(function: Any, options: dict[str, Any]) -> Any:
    """Return the dispatcher of a function that kernels call."""
    without_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return without_literals(
        _njit(nogil=True, pipeline_class=InnerCompiler, **without_wrappers, **options)(function)
    )


def kernel_dispatcher(store: KernelStore, options: dict[str, Any]) -> Any:
    """Return the dispatcher of a kernel that Python calls, which caches the kernel on disk."""
    dispatcher = _njit(nogil=True, no_cfunc_wrapper=True, **options)(store.function)
    dispatcher._cache = KernelCache(store)  # noqa: SLF001
    return dispatcher


def compile_kernel(dispatcher: Any, types: str, arguments: tuple[Any, ...]) -> Callable[..., Any]:
    """Compile a kernel, given its dispatcher, or load it from the cache, for the types of some arguments.

    Raises
    ------
    TypeError
        `starid.kernels.jit` and numba name the types differently, so the kernel would never be found in the cache.
    """
    signature = tuple(dispatcher.typeof_pyval(each) for each in arguments)
    if names_of_types(signature) != types:
        raise TypeError(f"{dispatcher.py_func.__name__}: arguments of types {types}, in numba {signature}")
    return cast("Callable[..., Any]", dispatcher.compile(signature))


def names_of_types(signature: Iterable[Any]) -> str:
    """Return the names of types, as `starid.kernels.jit.type_names` returns those of arguments."""
    return ", ".join(_name_of_type(each) for each in signature)


def _name_of_type(each: Any) -> str:
    if isinstance(each, _types.Array) and isinstance(each.dtype, _types.Record):
        name = record_name((field, str(kind)) for field, kind in each.dtype.members)
        return f"{'' if each.mutable else 'readonly '}array({name}, {each.ndim}d, {each.layout})"
    if not isinstance(each, _types.BaseTuple):
        return str(each)
    name = each.instance_class.__name__ if isinstance(each, _types.BaseNamedTuple) else "tuple"
    return f"{name}({names_of_types(each.types)})"
