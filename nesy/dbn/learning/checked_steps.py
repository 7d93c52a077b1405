"""Steps given from outside as columns: what cannot be counted is refused before it is counted as something else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nesy.checked_arrays import integers
from nesy.dbn.rows import code_type
from nesy.errors import UserError

MOST_VALUES = 1 << 16
"""Most values of a factor: its table alone has as many columns."""
MOST_WEIGHT = 1 << 53
"""Most meetings in all: what is counted is summed up in floats."""


@dataclass(frozen=True)
class Steps:
    """Transitions in columns, each met at least once."""

    codes: np.ndarray
    """Integers [n, N]."""
    actions: np.ndarray
    """Integers [n]."""
    next_codes: np.ndarray
    """Integers [n, N]."""
    weights: np.ndarray
    """int64 [n], positive: how often each was met."""
    num_values: int
    """K."""
    num_actions: int
    """A."""

    @classmethod
    def of(
        cls,
        codes: ArrayLike,
        actions: ArrayLike | Sequence[str],
        next_codes: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        num_values: int,
        num_actions: int | None = None,
        action_names: Sequence[str] | None = None,
    ) -> Steps:
        """Check some columns; lists, truth values and whole floats will do where they are exact.

        Args:
            codes: [n, N], values 0 to K - 1.
            actions: [n], numbers, or names of `action_names`.
            next_codes: [n, N].
            weights: [n], how often each transition was met; once each by default. One met 0 times is left out.
            num_values: K.
            num_actions: A; by default as many as there are names, or the largest action met, plus one.
            action_names: A names.

        Raises:
            UserError: something else, or no transition at all; the message says what and where.
        """
        number = _count(num_values, "num_values", MOST_VALUES)
        before = integers(codes, "codes", (None, None), number)
        rows, width = before.shape
        if not rows or not width:
            raise UserError("a 2DBN needs at least one transition of at least one factor to be counted from")
        after = integers(next_codes, "next codes", (rows, width), number)
        taken, total = _actions(actions, rows, num_actions, action_names)
        often = _weights(weights, rows)
        met = often > 0
        if not met.any():
            raise UserError("a 2DBN needs at least one transition that was met: all weights are 0")
        kind = code_type(number)
        before, after = before.astype(kind, copy=False), after.astype(kind, copy=False)
        if not met.all():
            before, taken, after, often = before[met], taken[met], after[met], often[met]
        return cls(before, taken, after, often, number, total)

    def under(self, action: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Codes, next codes and weights of the steps with one action."""
        here = self.actions == action
        return self.codes[here], self.next_codes[here], self.weights[here]


def _count(value: int, what: str, most: int) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not 1 <= value <= most:
        raise UserError(f"{what} is a whole number from 1 to {most}, not {value!r}")
    return int(value)


def _actions(
    actions: ArrayLike | Sequence[str], rows: int, num_actions: int | None, names: Sequence[str] | None
) -> tuple[np.ndarray, int]:
    total = None if num_actions is None else _count(num_actions, "num_actions", MOST_VALUES)
    if names is not None:
        if total is not None and total != len(names):
            raise UserError(f"there are {len(names)} action_names but num_actions is {total}")
        total = len(names)
    given: ArrayLike = actions
    if np.asarray(actions).dtype.kind in "UO" and all(isinstance(action, str) for action in np.ravel(actions)):
        places = {name: place for place, name in enumerate(names or ())}
        unknown = next((action for action in np.ravel(actions) if action not in places), None)
        if unknown is not None:
            known = f"one of {', '.join(names)}" if names else "a number, or action_names must list the names"
            raise UserError(f"'{unknown}' is no action; an action is {known}")
        given = np.array([places[action] for action in np.ravel(actions)], dtype=np.int64)
    taken = integers(given, "actions", (rows,), total or MOST_VALUES)
    return taken, total or int(taken.max()) + 1


def _weights(weights: ArrayLike | None, rows: int) -> np.ndarray:
    if weights is None:
        return np.ones(rows, dtype=np.int64)
    often = integers(weights, "weights (how often each transition was met)", (rows,)).astype(np.int64)
    if float(often.sum(dtype=np.float64)) > MOST_WEIGHT:
        raise UserError(f"the weights add up to more than {MOST_WEIGHT}: more transitions than can be counted")
    return often
