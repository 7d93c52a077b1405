"""How the kernels are compiled: cached on disk, and compiled again when any of them changes.

Numba looks only at a function's own file to see whether its cached code is stale. A kernel is also made of what
it calls in other files, so here the stamp of the cache covers the whole package.

Numba turns every function that it compiles into optimised machine code, also one that only other kernels call; and
as a caller's code contains that of all it calls, deep calls are optimised and translated again at every level. Here
only the functions that Python calls are: the others are kept as unoptimised code of LLVM, which is linked into them.
What that is worth: docs/notes/speed.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba._dynfunc import make_function
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

_TASK = Path(__file__).parents[1]
_FILES = [_TASK.parent / "core.py", *sorted(_TASK.rglob("*.py"))]
_STAMP = tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in _FILES)
_JIT: Callable[..., Any] = njit
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _LinkedLibrary(JITCodeLibrary):
    """Code that is only ever linked into that of callers: neither optimised by itself nor turned to machine code."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(NativeLowering):
    """Lowering into a `_LinkedLibrary`."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        low = state["cr"]
        # Callers' code knows the function by this object, which Python cannot call: there is no machine code behind it.
        handle = make_function(low.fndesc.lookup_module(), low.fndesc.qualname, "", 0, low.env, (state.library,))
        state.targetctx.insert_user_function(handle, low.fndesc, [state.library])
        state["cr"] = _LowerResult(low.fndesc, low.call_helper, cfunc=handle, env=low.env)
        return True


class _LinkedCompiler(CompilerBase):
    """Numba's own pipeline, but for the lowering."""

    def define_pipelines(self) -> list[Any]:
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.passes = [
            (_LinkedLowering, text) if kind is NativeLowering else (kind, text) for kind, text in pipeline.passes
        ]
        pipeline._finalized = False
        pipeline.finalize()
        return [pipeline]


def entry(function: Callable[..., Any]) -> Any:
    """Compile a function that is called from Python."""
    dispatcher = _JIT(cache=True, **_OPTIONS)(function)
    cache_file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None and hasattr(cache_file, "_source_stamp"):
        cache_file._source_stamp = _STAMP
    return dispatcher


def inner(function: Callable[..., Any]) -> Any:
    """Compile a function that only compiled functions call; Python must not call it."""
    return _JIT(no_cpython_wrapper=True, pipeline_class=_LinkedCompiler, **_OPTIONS)(function)
