"""The 2DBN as one Bayesian network, for formats that know nothing of actions or time.

Its nodes are the N factors of slice t, and for every action a copy of the N factors of slice t+1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError


@dataclass(frozen=True)
class Node:
    """One variable."""

    name: str
    parents: tuple[str, ...]
    tensor: np.ndarray
    """float64 [K] * parents + [K]: an axis per parent, the node's own last."""


def node_names(dbn: TwoSliceDBN) -> tuple[list[str], list[list[str]]]:
    """Names of the nodes of slice t [N], and of slice t+1 [A][N], as identifiers.

    Raises:
        UserError: two names become the same identifier.
    """
    factors = [identifier(name) for name in dbn.factor_names]
    later = [[f"{factor}__{identifier(action)}" for factor in factors] for action in dbn.action_names]
    every = factors + [name for names in later for name in names]
    if len(set(every)) != len(every):
        raise UserError("two names of factors or actions differ only in signs that this format cannot hold")
    return factors, later


def identifier(name: str) -> str:
    """A name of letters, digits and underscores."""
    cleaned = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
    return f"n{cleaned}" if cleaned[0].isdigit() else cleaned


def nodes(dbn: TwoSliceDBN) -> Iterator[Node]:
    """All nodes, slice t first."""
    now, later = node_names(dbn)
    for i, name in enumerate(now):
        yield Node(name, (), dbn.initial[i])
    for a in range(dbn.num_actions):
        for i in dbn.order:
            parents = tuple((now, later[a])[where][p] for where, p in dbn.parents(a, i))
            yield Node(later[a][i], parents, dbn.tensor(a, i))
