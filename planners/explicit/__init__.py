"""POMDPs as tables: files, the offline solver with certified bounds, pomdp-py both ways."""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "TabularPOMDP": "planners.explicit.pomdp",
    "solve": "planners.explicit.point_based",
}

__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        value = globals()[name] = getattr(importlib.import_module(_WHERE[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
