"""QMDP: act as if everything became known after the next step (Littman, Cassandra, Kaelbling 1995).

    explicit models    argmax_a sum_s b(s) Q_MDP(s, a)
    person following   argmax_a E_{s ~ b}[ r + discount V(c', lost') ], V from the relational part (bounds)

What a search gains over it is what looking, and looking ahead, are worth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nesy.compiled import njit
from nesy.errors import UserError
from planners.config import SearchConfig
from planners.person_following.ialm import IALM
from planners.person_following.kernels import Model
from planners.person_following.local_walk import LocalModel
from planners.search.random_bits import stream
from planners.search.walk import advance, best_tried, room


class TabularQMDP:
    """QMDP in an explicit POMDP.

    Args:
        model: a `planners.explicit.pomdp.TabularPOMDP`.
    """

    def __init__(self, model: Any) -> None:
        self.q = model.fully_observed

    def plan(self, belief: np.ndarray, allowed: np.ndarray | None = None) -> tuple[int, dict[str, Any]]:
        """The action, and the value of each; belief float64 [S], allowed bool [A]."""
        values = self.q @ belief
        if allowed is not None and not np.any(allowed):
            raise UserError("a search needs at least one allowed action")
        masked = values if allowed is None else np.where(allowed, values, -np.inf)
        return int(masked.argmax()), {"values": values.tolist(), "upper": float(values.max())}


class LocalQMDP:
    """QMDP in a particle belief over the influence-augmented local model; parameters as of `IALMSearch`."""

    def __init__(self, model: IALM, compiled: Model, config: SearchConfig, rng: np.random.Generator) -> None:
        self.local = LocalModel(compiled, np.ascontiguousarray(model.leaf_values))
        self.num_actions, self.discount = model.dbn.num_actions, config.per_step
        self._bits = stream(rng)

    def plan(
        self, belief: np.ndarray, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, Any]]:
        """The action, and the value of each; belief int16 [P, 2N + 5], allowed bool [A]; it searches for no time."""
        mask = np.ones(self.num_actions, np.bool_) if allowed is None else np.asarray(allowed, np.bool_)
        if not mask.any():
            raise UserError("a search needs at least one allowed action")
        values = _one_step(self.local, belief, self.num_actions, self.discount, self._bits)
        info = {"values": values.tolist(), "visits": [len(belief)] * self.num_actions, "simulations": belief.shape[0]}
        return best_tried(info, mask), info


@njit(cache=True)
def _one_step(local: LocalModel, belief: np.ndarray, num_actions: int, discount: float, bits: np.ndarray) -> np.ndarray:
    """Mean of r + discount V(s') over the particles, for every action: float64 [A]."""
    _, after, scratch = room(local)
    values = np.zeros(num_actions)
    for a in range(num_actions):
        for p in range(belief.shape[0]):
            reward, ended, _, leaf = advance(local, belief[p], a, after, scratch, bits)
            values[a] += (reward + (0.0 if ended else discount * leaf)) / belief.shape[0]
    return values
