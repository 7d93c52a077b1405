"""Symmetries that a domain may declare: what is learned from one step then holds for its images too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Symmetry:
    """A change of views and actions that the world takes no notice of: the image of a step is a step as likely."""

    name: str
    actions: tuple[int, ...]
    """Action a becomes `actions[a]`; each action comes once."""
    views: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
    """The images `[n, v, v]` of views `[n, v, v]`, no two views with the same one."""


@runtime_checkable
class Symmetries(Protocol):
    """What a domain may offer besides: symmetries of its worlds. Steps learned from then count for their images too."""

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Symmetries that hold on every map and variant taken together; those they make up need not be listed."""
        ...


def symmetries_of(domain: object) -> tuple[Symmetry, ...]:
    """The symmetries that a domain declares; none where it declares nothing."""
    return tuple(domain.symmetries) if isinstance(domain, Symmetries) else ()
