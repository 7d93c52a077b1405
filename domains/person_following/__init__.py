"""Person following in crossing maps: the task, its variants, experts, oracles and metrics."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from domains.person_following.domain import DOMAIN as DOMAIN
    from domains.person_following.oracles.oracle_table import oracle_row as oracle_row
    from domains.person_following.speed import benchmark as benchmark

__all__ = ["DOMAIN", "benchmark", "oracle_row"]

_PLACES = {"DOMAIN": "domain", "benchmark": "speed", "oracle_row": "oracles.oracle_table"}


def __getattr__(name: str) -> Any:
    # Compiled kernels load slowly, so they load when first asked for.
    if name in _PLACES:
        value = getattr(importlib.import_module(f"domains.person_following.{_PLACES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
