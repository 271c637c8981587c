"""How compiled kernels are linked and loaded, to compile less on the first start and to load less on later ones.

numba optimises every function, with all that it calls, and turns it into machine code, before it links it into
its callers, where both happen again. A function of `starid.jit.inner` is called by kernels only: its code is left
as it is until a kernel is optimised as a whole. And numba parses the intermediate code of each kernel that it
loads from the cache; here only if another kernel calls it.
"""

from __future__ import annotations

from typing import Any, Final

from numba.core import caching, codegen, types
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering

_codegen: Any = codegen
_llvm: Any = _codegen.ll
_types: Any = types
_Library: Any = _codegen.JITCodeLibrary
_Lowering: Any = NativeLowering
_Compiler: Any = CompilerBase
_PassBuilder: Any = DefaultPassBuilder
_PassManager: Any = PassManager
_register_pass: Any = register_pass
_CacheImpl: Any = caching.CompileResultCacheImpl

_NO_CODE: Final[bytes] = _llvm.parse_assembly("").as_bitcode()


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


class LoadedKernels(_CacheImpl):  # type: ignore[misc]
    """numba's conversion of a kernel to and from its file, which parses intermediate code only when it is linked."""

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Return the kernel of a file's content."""
        (name, kind, (machine_code, bitcode)), description, *rest = payload
        names = ("llvm_func_name", "llvm_cpython_wrapper_name", "llvm_cfunc_wrapper_name")
        engine = target_context.codegen()._engine  # noqa: SLF001
        engine._defined_symbols.update(getattr(description, each) for each in names)  # noqa: SLF001
        kernel = super().rebuild(target_context, ((name, kind, (machine_code, _NO_CODE)), description, *rest))
        kernel.library._get_module_for_linking = lambda: _llvm.parse_bitcode(bitcode)  # noqa: SLF001
        return kernel
