"""The fast informed bound of an explicit POMDP (Hauskrecht 2000), from above at any time.

    Q(a, s) = R(a, s) + discount sum_o max_a' sum_s' T[a](s, s') Z(a, s', o) Q(a', s')
    V(b) <= max_a sum_s b(s) Q(a, s)

A discounted maximum over policies (what to do after each observation), bounded by `state_bounds.bracket`.
"""

from __future__ import annotations

import math
import time

import numpy as np
from scipy import sparse

from nesy.compiled import njit
from planners.explicit.bound_kernels import FlatPOMDP
from planners.explicit.pomdp import TabularPOMDP
from planners.explicit.state_bounds import bracket

_TOLERANCE = 1e-7  # relative; where the search starts, so it need not be sharper
_AT_ONCE = 10_000_000  # products between two looks at the clock
_MOST_TERMS = 20_000_000  # of a linear system


class Informed:
    """F of the fast informed bound over x = Q, float64 [A * S]; see `state_bounds.Process`."""

    def __init__(self, flat: FlatPOMDP) -> None:
        self.flat, self.discount = flat, flat.discount
        num_actions, num_states = flat.reward.shape
        self.gains = np.stack([flat.reward.reshape(-1)] * 2)
        paths = np.add.reduceat(
            np.diff(flat.shown, axis=1)[self._actions(), flat.successor], flat.begin[:, :-1].ravel()
        )
        self.terms, self.paths = int(paths.max()), int(paths.sum())
        self.block = max(1, _AT_ONCE * num_states // (self.paths // num_actions * num_actions**2 + 1))

    def _actions(self) -> np.ndarray:
        """The action that each transition belongs to, int64 [entries]."""
        return np.repeat(np.arange(len(self.flat.begin)), self.flat.begin[:, -1] - self.flat.begin[:, 0])

    def apply(self, x: np.ndarray, deadline: float) -> tuple[np.ndarray, np.ndarray] | None:
        """See `Process`; the policy is a number per entry, made of all its choices."""
        num_actions, num_states = self.flat.reward.shape
        self.values = np.ascontiguousarray(x.reshape(num_actions, num_states).T)
        out, choices = np.empty((num_actions, num_states)), np.empty((num_actions, num_states), np.int64)
        for a in range(num_actions):
            for s in range(0, num_states, self.block):
                if time.perf_counter() >= deadline:
                    return None
                _informed(self.flat, self.values, a, s, min(s + self.block, num_states), out, choices)
        return out.reshape(-1), choices.reshape(-1)

    def system(self) -> tuple[sparse.csr_array, np.ndarray] | None:
        """See `Process`."""
        if self.paths > _MOST_TERMS:
            return None
        rows, columns, chances = _policy(self.flat, self.values, self.paths)
        size = self.flat.reward.size
        return sparse.csr_array((chances, (rows, columns)), (size, size)), self.flat.reward.reshape(-1)


def fast_informed_bound(
    model: TabularPOMDP, flat: FlatPOMDP, fully_observed: np.ndarray, deadline: float = math.inf
) -> np.ndarray:
    """Upper bound of the value per state, float64 [S].

    Args:
        model: the POMDP.
        flat: its arrays.
        fully_observed: Q of the fully observed process from above, float64 [A, S]; nothing returned exceeds it.
        deadline: of `time.perf_counter`, after which to stop; what was found by then is a bound all the same.
    """
    ends = np.tile(model.terminal, len(model.actions))
    high = bracket(Informed(flat), ends, deadline, _TOLERANCE, fully_observed.reshape(-1))[1]
    return np.asarray(np.minimum(high.reshape(fully_observed.shape), fully_observed).max(axis=0))


@njit(cache=True)
def _weigh(
    flat: FlatPOMDP, values: np.ndarray, action: int, state: int, worth: np.ndarray, known: np.ndarray, seen: np.ndarray
) -> int:
    """Fill worth[o] [A] with what each next action is worth after each observation; how many, listed in `seen`."""
    kinds = 0
    for entry in range(flat.begin[action, state], flat.begin[action, state + 1]):
        after = flat.successor[entry]
        for e in range(flat.shown[action, after], flat.shown[action, after + 1]):
            o = flat.seen[e]
            if not known[o]:
                known[o] = True
                seen[kinds] = o
                kinds += 1
                worth[o] = 0.0
            chance = flat.probability[entry] * flat.seen_chance[e]
            for a in range(values.shape[1]):
                worth[o, a] += chance * values[after, a]
    for k in range(kinds):
        known[seen[k]] = False
    return kinds


@njit(cache=True)
def _informed(
    flat: FlatPOMDP, values: np.ndarray, action: int, first: int, end: int, out: np.ndarray, choices: np.ndarray
) -> None:
    """F at (action, first : end); values float64 [S, A]."""
    num_actions = values.shape[1]
    worth = np.empty((flat.num_observations, num_actions))
    known, seen = np.zeros(flat.num_observations, np.bool_), np.empty(flat.num_observations, np.int64)
    for s in range(first, end):
        total, mixed = 0.0, 0
        for k in range(_weigh(flat, values, action, s, worth, known, seen)):
            best = worth[seen[k]].argmax()
            total += worth[seen[k], best]
            mixed = mixed * 1_000_003 + best
        out[action, s] = flat.reward[action, s] + flat.discount * total
        choices[action, s] = mixed


@njit(cache=True)
def _policy(flat: FlatPOMDP, values: np.ndarray, paths: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(row, column, chance) of every way from (a, s) by s' and o to (a', s'), a' the best after o; may repeat."""
    num_actions, num_states = flat.reward.shape
    rows, columns, chances = np.empty(paths, np.int64), np.empty(paths, np.int64), np.empty(paths)
    worth, best = np.empty((flat.num_observations, num_actions)), np.zeros(flat.num_observations, np.int64)
    known, seen = np.zeros(flat.num_observations, np.bool_), np.empty(flat.num_observations, np.int64)
    count = 0
    for a in range(num_actions):
        for s in range(num_states):
            for k in range(_weigh(flat, values, a, s, worth, known, seen)):
                best[seen[k]] = worth[seen[k]].argmax()
            for entry in range(flat.begin[a, s], flat.begin[a, s + 1]):
                after = flat.successor[entry]
                for e in range(flat.shown[a, after], flat.shown[a, after + 1]):
                    rows[count], columns[count] = a * num_states + s, best[flat.seen[e]] * num_states + after
                    chances[count] = flat.probability[entry] * flat.seen_chance[e]
                    count += 1
    return rows, columns, chances
