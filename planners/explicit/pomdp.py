"""Explicit POMDPs: tables small enough to be written down, and exact belief updates over them.

    S, A, O   named; T[a] a sparse matrix [S, S'], Z[a, s', o], R[a, s] (expected), discount, start, terminal
    b'(s')  ~ Z[a, s', o] sum_s b(s) T[a][s, s']

Terminal states are marked as such: they earn nothing and are never left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from nesy.errors import UserError
from planners.explicit.pomdp_file import read, write

_OFF = 1e-5  # by which a row may miss 1, or by what writing its entries with six digits makes of it
_HALF_DIGIT = 5e-7


class CrossedBounds(ArithmeticError):
    """A lower bound above an upper one by more than rounding explains: a bug of ours."""


@dataclass(frozen=True, eq=False, repr=False)
class TabularPOMDP:
    """An explicit POMDP; arrays (or nested lists) as in the module's head, checked and copied when built.

    Rows of probabilities that were rounded to six digits are scaled to sum to 1.

    Raises:
        UserError: probabilities that do not sum to 1, names given twice, shapes that do not fit.
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
        for what in ("states", "actions", "observations"):
            self._set(what, _names(what, getattr(self, what)))
        num_states, num_actions, num_observations = len(self.states), len(self.actions), len(self.observations)
        try:
            matrices = [_matrix(matrix) for matrix in self.transition]
        except (TypeError, ValueError) as error:
            raise UserError(f"transition: one matrix of numbers [S, S'] per action is needed ({error})") from None
        for what in ("observation", "reward", "start"):
            self._set(what, _numbers(what, getattr(self, what)))
        self._set("terminal", _flags(self.terminal))
        discount = _numbers("discount", self.discount)
        self._set("discount", float(discount) if discount.ndim == 0 else math.nan)
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
            raise UserError(f"discount must be in [0, 1], got {discount}")
        self._check_rewards()
        if any((table < 0).any() for table in (*(m.data for m in matrices), self.observation, self.start)):
            raise UserError("a probability is negative")
        for a, action in enumerate(self.actions):
            scales = self._scales(f"transitions of action '{action}'", matrices[a], np.diff(matrices[a].indptr))
            matrices[a].data *= np.repeat(scales, np.diff(matrices[a].indptr))
            used = np.count_nonzero(self.observation[a], axis=1)
            self.observation[a] *= self._scales(f"observations of action '{action}'", self.observation[a], used)[
                :, None
            ]
        self._set("transition", tuple(matrices))
        total = self.start.sum()
        if not abs(total - 1) <= max(_OFF, _HALF_DIGIT * np.count_nonzero(self.start)):
            raise UserError(f"start probabilities sum to {total:.6g}, not 1")
        self._set("start", self.start / total)
        self._check_ends()

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _scales(self, what: str, rows: Any, used: np.ndarray) -> np.ndarray:
        """Factors that make every row sum to 1, float64 [S]; `used` int [S] counts the entries of each."""
        sums = np.asarray(rows.sum(axis=1)).reshape(-1)
        wrong = np.flatnonzero(~(np.abs(sums - 1) <= np.maximum(_OFF, _HALF_DIGIT * used)))
        if wrong.size:
            s = int(wrong[0])
            raise UserError(f"{what} in state '{self.states[s]}' sum to {sums[s]:.6g}, not 1")
        exact = np.abs(sums - 1) <= used * np.finfo(float).eps
        return np.where(exact, 1.0, 1 / sums)

    def _check_rewards(self) -> None:
        if not np.isfinite(self.reward).all():
            raise UserError("a reward is not a number")
        with np.errstate(over="ignore"):
            worth = np.abs(self.reward).max() / max(1 - self.discount, np.finfo(float).eps)
        if not worth < 1e300:
            raise UserError(f"rewards up to {np.abs(self.reward).max():.3g} at discount {self.discount} are too large")

    def _check_ends(self) -> None:
        ends = np.flatnonzero(self.terminal)
        for a, action in enumerate(self.actions):
            stays = np.asarray(self.transition[a][ends][:, ends].sum(axis=1)).reshape(-1)
            wrong = (np.abs(stays - 1) > 1e-9) | (self.reward[a, ends] != 0)
            if wrong.any():
                state = self.states[int(ends[wrong.argmax()])]
                raise UserError(f"action '{action}' leaves a terminal state or earns something there ('{state}')")

    def __repr__(self) -> str:
        sizes = f"{len(self.states)} states, {len(self.actions)} actions, {len(self.observations)} observations"
        return f"TabularPOMDP({sizes}, discount {self.discount:g})"

    @classmethod
    def from_file(cls, path: Path | str) -> TabularPOMDP:
        """Read Cassandra's `.pomdp` format (planners.explicit.pomdp_file)."""
        try:
            return cls(**read(Path(path)))
        except UserError as error:
            raise error if str(error).startswith(str(path)) else UserError(f"{path}: {error}") from None

    def to_file(self, path: Path | str) -> None:
        """Write Cassandra's `.pomdp` format."""
        write(self, Path(path))

    def check_belief(self, belief: np.ndarray) -> np.ndarray:
        """The belief as float64 [S], scaled to sum to 1.

        Raises:
            UserError: another shape, or no distribution.
        """
        checked = _numbers("a belief", belief)
        if checked.shape != self.start.shape:
            raise UserError(f"a belief has the shape {list(self.start.shape)}, found {list(checked.shape)}")
        if not ((checked >= 0).all() and abs(checked.sum() - 1) <= _OFF):
            raise UserError("a belief is a probability distribution (numbers >= 0 that sum to 1)")
        return np.asarray(checked / checked.sum())

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
        """Q of the fully observed process: float64 [A, S] (QMDP), from above; an upper bound for every belief.

        Raises:
            UserError: a discount of 1, at which the process need not have a value.
        """
        from planners.explicit.state_bounds import optimum

        check_solvable(self, "the fully observed process")
        return optimum(self)


def _names(what: str, names: Any) -> tuple[str, ...]:
    try:
        checked = () if isinstance(names, str) else tuple(names)
    except TypeError:
        checked = ()
    if not checked:
        raise UserError(f"{what}: a list of one or more names is needed, got {names!r}")
    seen: set[str] = set()
    for name in checked:
        if not isinstance(name, str):
            raise UserError(f"{what}: names are strings, got {name!r}")
        if name in seen:
            raise UserError(f"{what}: the name '{name}' is given twice")
        seen.add(name)
    return checked


def _numbers(what: str, values: Any) -> np.ndarray:
    """A float64 copy."""
    try:
        return np.array(values, np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise UserError(f"{what}: numbers are needed ({error})") from None


def _flags(values: Any) -> np.ndarray:
    try:
        flags = np.array(values)
    except ValueError as error:
        raise UserError(f"terminal: true or false per state is needed ({error})") from None
    if flags.dtype != np.bool_ and not (flags.dtype.kind in "iuf" and np.isin(flags, (0, 1)).all()):
        raise UserError("terminal: true or false per state is needed")
    return flags.astype(np.bool_)


def _matrix(values: Any) -> sparse.csr_array:
    """A copy in float64, sorted, without zeros."""
    if not sparse.issparse(values):
        values = np.asarray(values, np.float64)
        if values.ndim != 2:
            raise ValueError(f"got one of {values.ndim} dimensions")
    matrix = sparse.csr_array(values, dtype=np.float64, copy=True)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix


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
