"""Agents that act over the factored belief: belief DQN, POMDP planners, baselines, and their comparison."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any


def __getattr__(name: str) -> Any:
    """Submodules are imported when they are first asked for: `import planners` alone stays light."""
    if not name.startswith("_") and importlib.util.find_spec(f"planners.{name}") is not None:
        return importlib.import_module(f"planners.{name}")
    raise AttributeError(f"module 'planners' has no attribute '{name}'")
