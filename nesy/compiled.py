"""`njit` whose cache on disk notices every change.

Numba looks only at a function's own file to see whether its cached code is stale. A kernel is also made of what
it calls in other files, so here the stamp of every cache covers all files of `nesy` and `planners` that hold
kernels: after an update of the package, no kernel runs with callees of the version before.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_ROOT = Path(__file__).parent.parent


def _kernel_files() -> list[Path]:
    files = [path for package in ("nesy", "planners") for path in sorted((_ROOT / package).rglob("*.py"))]
    return [path for path in files if b"import njit" in path.read_bytes()]


STAMP = tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in _kernel_files())
"""Name, time and size of every file with kernels."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)`, its cache stamped with `STAMP`."""

    def compile_later(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        cache_file = getattr(dispatcher._cache, "_cache_file", None)  # None where nothing is cached
        if cache_file is not None:
            cache_file._source_stamp = STAMP
        return dispatcher

    return compile_later


def overload(function: Callable[..., Any]) -> Callable[..., Any]:
    """`numba.extending.overload(function)`: choose by the types of the arguments what compiled code runs for it."""
    from numba.extending import overload as by_types

    decorator: Callable[..., Any] = by_types(function, strict=False)
    return decorator
