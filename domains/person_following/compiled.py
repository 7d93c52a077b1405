"""How the kernels are compiled: cached on disk, and compiled again when any of them changes.

Numba looks only at a function's own file to see whether its cached code is stale. A kernel is also made of what
it calls in other files, so here the stamp of the cache covers the whole package.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_FILES = [Path(__file__).parent.parent / "core.py", *sorted(Path(__file__).parent.glob("*.py"))]
_STAMP = tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in _FILES)
_JIT: Callable[..., Any] = njit
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def entry(function: Callable[..., Any]) -> Any:
    """Compile a function that is called from Python."""
    return _stamped(_JIT(**_OPTIONS)(function))


def inner(function: Callable[..., Any]) -> Any:
    """Compile a function that only compiled functions call; Python must not call it.

    Leaving out the wrapper that Python would need halves the time to compile.
    """
    return _stamped(_JIT(**_OPTIONS, no_cpython_wrapper=True)(function))


def _stamped(dispatcher: Any) -> Any:
    cache_file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None and hasattr(cache_file, "_source_stamp"):
        cache_file._source_stamp = _STAMP
    return dispatcher
