"""Expected rewards of pomdp-py's reward models.

    R[a, s] = sum_s' T[a][s, s'] E[r | s, a, s']

pomdp-py only says how to draw a reward. A model that says the same each time is read off; one with probabilities over
few values gives its expectation; any other is refused, or averaged over as many draws as the caller asks for.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse

from nesy.errors import UserError

_FEWEST_LOOKS, _MOST_LOOKS = 8, 1000
"""How often a step's reward is drawn to see whether it changes, and all of them together at least."""


def expected_rewards(
    model: Any,
    states: Sequence[Any],
    actions: Sequence[Any],
    transition: Sequence[sparse.csr_array],
    ends: np.ndarray,
    draws: int | None = None,
) -> np.ndarray:
    """R[a, s]: float64 [A, S], 0 in terminal states.

    A model that draws is recognised by other rewards for the same step (at least 8 draws a step, 1,000 in all) or by
    its use of Python's or NumPy's global generator.

    Args:
        model: has `sample(state, action, next_state)`, and perhaps `probability(reward, state, action, next_state)`.
        states: all states.
        actions: all actions.
        transition: [S, S] for each action.
        ends: bool [S], the terminal states.
        draws: how often to draw where probabilities are missing; None refuses.

    Raises:
        UserError: the model has no rewards, or draws them although `draws` is None.
    """
    out = np.zeros((len(actions), len(states)))
    looks = max(_FEWEST_LOOKS, _MOST_LOOKS // max(1, sum(matrix.nnz for matrix in transition)))
    for a, action in enumerate(actions):
        steps = sparse.coo_array(transition[a])
        for s, t, chance in zip(steps.row, steps.col, steps.data, strict=True):
            if not ends[s]:
                out[a, s] += chance * _expected(model, (states[s], action, states[t]), looks, draws)
    return out


def _expected(model: Any, step: tuple[Any, Any, Any], looks: int, draws: int | None) -> float:
    before = _global_generators()
    found = [_draw(model, step)]
    drawn = _global_generators() != before
    known = _probability(model, found[0], step)
    if known is not None and abs(known - 1) < 1e-9:
        return found[0]
    if known is None:
        found += [_draw(model, step) for _ in range(looks - 1)]
        if not drawn and len(set(found)) == 1:
            return found[0]
    else:
        found += [_draw(model, step) for _ in range(_MOST_LOOKS - 1)]
        chances = {reward: _probability(model, reward, step) or 0.0 for reward in set(found)}
        if abs(sum(chances.values()) - 1) < 1e-6:
            return sum(reward * chance for reward, chance in chances.items())
    if draws is None:
        state, action, _ = step
        raise UserError(
            f"the reward of action {action} in state {state} is drawn, and {type(model).__name__} tells no "
            "probabilities of few values; give `reward_draws` to average over so many draws"
        )
    return float(np.mean([_draw(model, step) for _ in range(draws)]))


def _global_generators() -> tuple[Any, ...]:
    kind, keys, *rest = np.random.get_state()  # noqa: NPY002 (nothing is drawn here; others' models draw from it)
    return random.getstate(), kind, np.asarray(keys).tobytes(), rest


def _draw(model: Any, step: tuple[Any, Any, Any]) -> float:
    try:
        return float(model.sample(*step))
    except (NotImplementedError, TypeError) as error:
        reason = str(error) or "`sample` is missing"
        raise UserError(f"{type(model).__name__} gives no reward for {step[1]} in {step[0]}: {reason}") from None


def _probability(model: Any, reward: float, step: tuple[Any, Any, Any]) -> float | None:
    try:
        return float(model.probability(reward, *step))
    except (NotImplementedError, AttributeError, TypeError):
        return None
