"""The perspective shift: what another agent sees and believes, by imagined walks in the learned model."""

from __future__ import annotations

import importlib
from typing import Any

_NAMES = (
    "PLANNERS",
    "InfluenceBelief",
    "PerspectiveShift",
    "Shift",
    "TableModel",
    "imagine",
    "shift",
)

_OF_INFLUENCE = ("INFLUENCE_MODES", "InfluencePrior")

__all__ = sorted((*_NAMES, *_OF_INFLUENCE))


def __getattr__(name: str) -> Any:
    """Names are handed on when they are first asked for: torch-free and numba-free imports stay light."""
    if name in (*_NAMES, *_OF_INFLUENCE):
        module = "nesy.perspective.operator" if name in _NAMES else "nesy.perspective.influence"
        value = globals()[name] = getattr(importlib.import_module(module), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
