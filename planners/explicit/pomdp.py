"""Explicit POMDPs: tables small enough to be written down, and exact belief updates over them.

    S, A, O   named; T[a] a sparse matrix [S, S'], Z[a, s', o], R[a, s] (expected), discount, start, terminal
    b'(s')  ~ Z[a, s', o] sum_s b(s) T[a][s, s']

Terminal states are marked as such: they earn nothing and are never left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from nesy.errors import UserError


@dataclass(frozen=True, eq=False)
class TabularPOMDP:
    """An explicit POMDP; arrays as in the module's head, checked when built.

    Raises:
        UserError: probabilities that do not sum to 1, or shapes that do not fit.
    """

    states: Sequence[str]
    actions: Sequence[str]
    observations: Sequence[str]
    transition: Sequence[sparse.csr_array]
    observation: np.ndarray
    reward: np.ndarray
    discount: float
    start: np.ndarray
    terminal: np.ndarray

    def __post_init__(self) -> None:
        num_states, num_actions, num_observations = len(self.states), len(self.actions), len(self.observations)
        matrices = tuple(sparse.csr_array(matrix) for matrix in self.transition)
        object.__setattr__(self, "transition", matrices)
        for name, found, wanted in (
            ("transition", [m.shape for m in matrices], [(num_states, num_states)] * num_actions),
            ("observation", self.observation.shape, (num_actions, num_states, num_observations)),
            ("reward", self.reward.shape, (num_actions, num_states)),
            ("start", self.start.shape, (num_states,)),
            ("terminal", self.terminal.shape, (num_states,)),
        ):
            if found != wanted:
                raise UserError(f"{name}: shape {found}, expected {wanted}")
        if not 0 <= self.discount <= 1:
            raise UserError(f"discount must be in [0, 1], got {self.discount}")
        self._check_distributions()

    def _check_distributions(self) -> None:
        for a, name in enumerate(self.actions):
            rows = np.asarray(self.transition[a].sum(axis=1)).reshape(-1)
            for what, sums in (("transitions", rows), ("observations", self.observation[a].sum(axis=1))):
                if (wrong := np.flatnonzero(~(np.abs(sums - 1) <= 1e-5))).size:
                    s = int(wrong[0])
                    raise UserError(
                        f"{what} of action '{name}' in state '{self.states[s]}' sum to {sums[s]:.6g}, not 1"
                    )
            if self.terminal.any():
                ends = np.flatnonzero(self.terminal)
                stays = self.transition[a][ends][:, ends].sum(axis=1)
                if (np.abs(np.asarray(stays) - 1) > 1e-9).any() or self.reward[a, ends].any():
                    raise UserError(f"action '{name}' leaves a terminal state or earns something there")
        tables = [*(m.data for m in self.transition), self.observation, self.start]
        if any((table < 0).any() for table in tables):
            raise UserError("a probability is negative")
        if not np.isfinite(self.reward).all():
            raise UserError("a reward is not a number")
        if not abs(self.start.sum() - 1) <= 1e-5:
            raise UserError(f"start probabilities sum to {self.start.sum():.6g}, not 1")

    @classmethod
    def from_file(cls, path: Path | str) -> TabularPOMDP:
        """Read Cassandra's `.pomdp` format (planners.explicit.pomdp_file)."""
        from planners.explicit.pomdp_file import read

        return read(Path(path))

    def to_file(self, path: Path | str) -> None:
        """Write Cassandra's `.pomdp` format."""
        from planners.explicit.pomdp_file import write

        write(self, Path(path))

    def check_belief(self, belief: np.ndarray) -> np.ndarray:
        """The belief as float64 [S].

        Raises:
            UserError: another shape, or no distribution.
        """
        checked = np.asarray(belief, np.float64)
        if checked.shape != self.start.shape:
            raise UserError(f"a belief has the shape {list(self.start.shape)}, found {list(checked.shape)}")
        if not ((checked >= 0).all() and abs(checked.sum() - 1) <= 1e-5):
            raise UserError("a belief is a probability distribution (numbers >= 0 that sum to 1)")
        return checked

    def predict(self, belief: np.ndarray, action: int) -> np.ndarray:
        """Belief after the action, before the observation: [S] -> [S]."""
        predicted: np.ndarray = belief @ self.transition[action]
        return predicted

    def observation_chances(self, belief: np.ndarray, action: int) -> np.ndarray:
        """P(o | b, a): float64 [O]."""
        chances: np.ndarray = self.predict(belief, action) @ self.observation[action]
        return chances

    def update(self, belief: np.ndarray, action: int, observation: int) -> np.ndarray:
        """Bayes: the belief after action and observation.

        Raises:
            UserError: the observation is impossible.
        """
        joint = self.predict(belief, action) * self.observation[action][:, observation]
        total = joint.sum()
        if total <= 0:
            raise UserError(
                f"'{self.observations[observation]}' is impossible after '{self.actions[action]}' in this belief"
            )
        updated: np.ndarray = joint / total
        return updated

    def step(self, state: int, action: int, rng: np.random.Generator) -> tuple[int, int, float]:
        """Draw (next state, observation, reward)."""
        row = self.transition[action]
        begin, end = row.indptr[state], row.indptr[state + 1]
        after = int(rng.choice(row.indices[begin:end], p=row.data[begin:end] / row.data[begin:end].sum()))
        seen = int(rng.choice(len(self.observations), p=self.observation[action][after]))
        return after, seen, float(self.reward[action, state])

    @cached_property
    def fully_observed(self) -> np.ndarray:
        """Q of the fully observed process: float64 [A, S] (QMDP; an upper bound for every belief)."""
        value = np.zeros(len(self.states))
        q = self.reward.copy()
        for _ in range(10_000):
            q = self.reward + self.discount * np.stack([matrix @ value for matrix in self.transition])
            after = q.max(axis=0)
            if np.abs(after - value).max() < 1e-10:
                break
            value = after
        return q


def check_solvable(model: TabularPOMDP, who: str) -> None:
    """Whether a model can be searched or solved.

    Raises:
        UserError: it is no `TabularPOMDP`, or its discount is 1.
    """
    if not isinstance(model, TabularPOMDP):
        kind = type(model).__name__
        raise UserError(f"{who} needs a TabularPOMDP, not a {kind}; built-in problems are TabularPOMDP(**tiger())")
    if not model.discount < 1:
        raise UserError(f"{who} needs a discount below 1")
