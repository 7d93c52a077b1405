"""How faithful the table is: to the network it was extracted from, and to the data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn.extraction import Conditionals
from nesy.dbn.factored import predict_batch
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import unique_rows

if TYPE_CHECKING:
    from nesy.dbn.extraction import Marginals, Transitions

FLOOR = 1e-12
"""Least probability that a likelihood is charged with, so that one impossible row does not hide the rest."""


def fidelity(dbn: TwoSliceDBN, model: Conditionals | Marginals | None, transitions: Transitions) -> dict[str, Any]:
    """The figures of the `dbn` section of summary.json.

    Args:
        dbn: the extracted model.
        model: the network it comes from, or what it predicts; None for a model counted from experience.
        transitions: the experience to measure on.

    Returns:
        `nll`: mean negative log-likelihood of a transition in nats (probabilities below 1e-12 count as
        1e-12, their share is `impossible`), `nll_limit`: the least that any model can have on the same
        transitions; `max_difference_to_network`: over every entry of every table where the network has
        tables, else of the predicted marginals of every code met; `rows`, `rows_met`,
        `max_parents`, `next_arcs` (arcs within slice t+1), `codes_met`.
    """
    figures: dict[str, Any] = {
        "rows": len(dbn.probabilities),
        "rows_met": int((dbn.row_counts > 0).sum()),
        "max_parents": max(len(dbn.parents(a, i)) for a in range(dbn.num_actions) for i in range(dbn.num_factors)),
        "next_arcs": sum(len(parents) for per_action in dbn.parents_next for parents in per_action),
        "codes_met": len(np.unique(transitions.view_codes, axis=0)),
        "views_met": len(transitions.views),
    }
    figures |= nll(dbn, transitions.codes, transitions.actions, transitions.next_codes)
    if isinstance(model, Conditionals):
        figures["max_difference_to_network"] = max_difference(dbn, model)
    elif model is not None:
        figures["max_difference_to_network"] = max_marginal_difference(dbn, model, transitions.view_codes)
    return figures


def max_marginal_difference(dbn: TwoSliceDBN, predict: Marginals, codes: np.ndarray) -> float:
    """The largest difference between predicted marginals of table and network, over some codes [n, N]."""
    kinds = np.unique(codes, axis=0)
    largest = 0.0
    for a in range(dbn.num_actions):
        ours = predict_batch(dbn, np.eye(dbn.num_values)[kinds], np.full(len(kinds), a))
        largest = max(largest, float(np.abs(ours - predict(kinds, a)).max()))
    return largest


def max_difference(dbn: TwoSliceDBN, model: Conditionals) -> float:
    """The largest difference of an entry between the tables and the network's conditionals."""
    return max(
        float(np.abs(dbn.cpt(a, i) - model.conditional(a, i)).max())
        for a in range(dbn.num_actions)
        for i in range(dbn.num_factors)
    )


def nll(dbn: TwoSliceDBN, codes: np.ndarray, actions: np.ndarray, next_codes: np.ndarray) -> dict[str, float]:
    """Mean negative log-likelihood of some transitions, and the least that any model can have on them.

    Args:
        dbn: the model.
        codes: uint8 [n, N].
        actions: int64 [n].
        next_codes: uint8 [n, N].

    Returns:
        `nll`, `nll_limit` (nats) and `impossible` (share of transitions with probability below 1e-12).
    """
    every = np.column_stack([codes, actions, next_codes]).astype(np.uint8)
    first, _, counts = unique_rows(every)
    kinds = every[first]
    n = dbn.num_factors
    logs = dbn.log_prob(kinds[:, :n], kinds[:, n], kinds[:, n + 1 :])
    weights = counts / counts.sum()
    _, context, _ = unique_rows(kinds[:, : n + 1])
    totals = np.bincount(context, weights=counts)
    return {
        "nll": float(-(weights * np.maximum(logs, np.log(FLOOR))).sum()),
        "nll_limit": float(max(0.0, -(weights * np.log(counts / totals[context])).sum())),
        "impossible": float(weights[logs < np.log(FLOOR)].sum()),
    }
