"""The 2DBN as one Bayesian network, for formats that know nothing of actions or time.

Its nodes are the N factors of slice t, and for every action a copy of the N factors of slice t+1; where the model
has them, the cells of the view of slice t, and for every action whether the episode ends. (A mean reward is no node.)
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
    """float64 [K] * parents + [M]: an axis per parent, the node's own last."""

    @property
    def size(self) -> int:
        """M, how many values the variable has."""
        return int(self.tensor.shape[-1])


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
    yield from _step_nodes(dbn, now, later)


def _step_nodes(dbn: TwoSliceDBN, now: list[str], later: list[list[str]]) -> Iterator[Node]:
    taken = {*now, *(name for names in later for name in names)}
    observation, termination = dbn.step_tables.get("observation"), dbn.step_tables.get("termination")
    # the view of slice t shows the code of slice t, as that of slice t+1 shows the next
    for t, name in enumerate(observation.targets if observation is not None else ()):
        assert observation is not None
        yield Node(_free(name, taken), tuple(now[p] for _, p in observation.parents(0, t)), observation.tensor(0, t))
    for a, action in enumerate(dbn.action_names if termination is not None else ()):
        assert termination is not None
        parents = tuple((now, later[a])[where][p] for where, p in termination.parents(a, 0))
        yield Node(_free(f"done__{identifier(action)}", taken), parents, termination.tensor(a, 0))


def _free(name: str, taken: set[str]) -> str:
    if identifier(name) in taken:
        raise UserError(f"a factor is called '{name}' like a node of an observation or termination table")
    return identifier(name)
