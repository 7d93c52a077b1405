"""What values should tell: a cost that keeps views together that answer questions alike."""

from __future__ import annotations

import numpy as np

DOUBT = 0.05
"""Views of either answer that every value is taken to have beside those it has."""


def telling_cost(answers: np.ndarray, codes: np.ndarray, factors: list[int], num_values: int) -> np.ndarray:
    """What values cost if they are to tell as much as they can about the questions: float64 [V, N, K], in nats.

    Every question is told by the factor that has most information about it. A value's cost for a view is the
    surprise at the view's answers to the factor's own questions, given the views that have the value now. Factors
    not in `factors` cost nothing.

    Args:
        answers: int [V, Q].
        codes: int64 [V, N].
        factors: those whose values may change.
        num_values: K.
    """
    num_views, num_factors = codes.shape
    one_hot = [(codes[:, i, None] == np.arange(num_values)).astype(np.float64) for i in range(num_factors)]
    chance = np.stack([(h.T @ answers + DOUBT) / (h.sum(0) + 2 * DOUBT)[:, None] for h in one_hot])  # [N, K, Q]
    surprise = -chance * np.log(chance) - (1 - chance) * np.log1p(-chance)
    left = np.stack([h.mean(0) @ surprise[i] for i, h in enumerate(one_hot)])  # [N, Q]
    teller = left.argmin(0)
    cost = np.zeros((num_views, num_factors, num_values))
    for i in factors:
        own = np.flatnonzero(teller == i)
        yes, no = np.log(chance[i][:, own]), np.log1p(-chance[i][:, own])
        cost[:, i] = -(answers[:, own] @ yes.T + (1 - answers[:, own]) @ no.T)
    return cost
