"""Person following in crossing maps: the task, its variants, experts, oracles and metrics."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from domains.person_following.domain import DOMAIN as DOMAIN

__all__ = ["DOMAIN"]


def __getattr__(name: str) -> Any:
    # Compiled kernels load slowly, so they load when first asked for.
    if name == "DOMAIN":
        from domains.person_following.domain import DOMAIN

        return DOMAIN
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
