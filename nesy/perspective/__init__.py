"""The perspective shift: what another agent sees and believes, by imagined walks in the learned model."""

from __future__ import annotations

import importlib
from typing import Any

_NAMES = (
    "INFLUENCE_MODES",
    "PLANNERS",
    "InfluenceBelief",
    "PerspectiveShift",
    "Shift",
    "TableModel",
    "imagine",
    "shift",
)

__all__ = sorted(_NAMES)


def __getattr__(name: str) -> Any:
    """Names are handed on when they are first asked for: torch-free and numba-free imports stay light."""
    if name in _NAMES:
        value = globals()[name] = getattr(importlib.import_module("nesy.perspective.operator"), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
