"""Questions to the symbolic model in answer set programming: meaning, plans, verification, shields."""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "Answer": "nesy.asp.program.solver",
    "Finding": "nesy.asp.finding",
    "KnowledgeBase": "nesy.asp.knowledge",
    "VOCABULARY": "nesy.asp.program.facts",
}

__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        value = globals()[name] = getattr(importlib.import_module(_WHERE[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
