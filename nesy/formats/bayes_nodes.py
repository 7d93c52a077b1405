"""The 2DBN as one Bayesian network, for formats that know nothing of actions or time.

Its nodes are the N factors of slice t, and for every action a copy of the N factors of slice t+1; where the model
has them, the cells of the view of slice t, and for every action whether the episode ends. (A mean reward is no node.)
A cell that is called like a factor gets the node `view__NAME`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.names import Grammar

NAMES = Grammar(
    never=r"_(?![A-Za-z0-9])",
    reserved=frozenset(
        ["default", "discrete", "done", "network", "probability", "property", "table", "type", "variable", "view"]
    ),
    suffix="__.*",
)
"""Names of factors and actions; `done` and `view` are the file's own nodes, the other words are those of BIF."""


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
    """Names of the nodes of slice t [N], and of slice t+1 [A][N], as identifiers; `__` comes before the action's."""
    factors = [NAMES.encode(name) for name in dbn.factor_names]
    return factors, [[f"{factor}__{NAMES.encode(action)}" for factor in factors] for action in dbn.action_names]


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
    observation, termination = dbn.step_tables.get("observation"), dbn.step_tables.get("termination")
    # the view of slice t shows the code of slice t, as that of slice t+1 shows the next
    for t, target in enumerate(observation.targets if observation is not None else ()):
        assert observation is not None
        name = NAMES.encode(target)
        parents = tuple(now[p] for _, p in observation.parents(0, t))
        yield Node(f"view__{name}" if name in now else name, parents, observation.tensor(0, t))
    for a, action in enumerate(dbn.action_names if termination is not None else ()):
        assert termination is not None
        parents = tuple((now, later[a])[where][p] for where, p in termination.parents(a, 0))
        yield Node(f"done__{NAMES.encode(action)}", parents, termination.tensor(a, 0))
