"""Perspective-shifted neuro-symbolic world models: learn, extract, query, explain.

Importing the package registers the Gymnasium ids of `domains`, and does nothing else.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import domains  # noqa: F401

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Submodules are imported when they are first asked for: `import nesy` alone stays light."""
    if not name.startswith("_") and importlib.util.find_spec(f"nesy.{name}") is not None:
        return importlib.import_module(f"nesy.{name}")
    raise AttributeError(f"module 'nesy' has no attribute '{name}'")
