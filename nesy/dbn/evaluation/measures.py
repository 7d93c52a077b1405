"""How faithful the table is: to the network it was extracted from, and to the data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.dbn.inference.factored import predict_batch
from nesy.dbn.learning.transitions import Conditionals
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import unique_rows

if TYPE_CHECKING:
    from nesy.dbn.learning.transitions import Marginals, Transitions

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
        `max_parents`, `next_arcs` (arcs within slice t+1), `codes_met`, `views_met`; `row_tv`, `row_kl`: total
        variation and KL divergence of the rows from the frequencies in the data, weighted by visits;
        `unknown_code_rate`: how often the table leads from a code met to a code that no view met has.
    """
    figures: dict[str, Any] = {
        "rows": len(dbn.probabilities),
        "rows_met": int((dbn.row_counts > 0).sum()),
        "max_parents": max(len(dbn.parents(a, i)) for a in range(dbn.num_actions) for i in range(dbn.num_factors)),
        "next_arcs": sum(len(parents) for per_action in dbn.parents_next for parents in per_action),
        "codes_met": len(np.unique(transitions.view_codes, axis=0)),
        "views_met": len(transitions.views),
    }
    taken = transitions.distinct()
    figures |= nll(dbn, *taken)
    figures |= row_differences(dbn, *taken)
    figures["unknown_code_rate"] = unknown_code_rate(dbn, np.unique(transitions.view_codes, axis=0))
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


def nll(
    dbn: TwoSliceDBN, codes: np.ndarray, actions: np.ndarray, next_codes: np.ndarray, counts: np.ndarray
) -> dict[str, float]:
    """Mean negative log-likelihood of some transitions, and the least that any model can have on them.

    Args:
        dbn: the model.
        codes: uint8 [n, N].
        actions: int64 [n].
        next_codes: uint8 [n, N].
        counts: int64 [n], how often each was met; the transitions are distinct.

    Returns:
        `nll`, `nll_limit` (nats) and `impossible` (share of transitions with probability below 1e-12).
    """
    kinds = np.column_stack([codes, actions, next_codes])
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


def row_differences(
    dbn: TwoSliceDBN, codes: np.ndarray, actions: np.ndarray, next_codes: np.ndarray, weights: np.ndarray
) -> dict[str, float]:
    """How far the rows are from the frequencies in some transitions (met `weights` times each).

    Returns:
        `row_tv` and `row_kl` (KL from frequencies to row, nats; probabilities below 1e-12 count as 1e-12).
    """
    k = dbn.num_values
    distance = divergence = total = 0.0
    for a in range(dbn.num_actions):
        chosen = actions == a
        now, later = codes[chosen].astype(np.int64), next_codes[chosen].astype(np.int64)
        for i in range(dbn.num_factors):
            cell = dbn.rows(a, i, now, later) * k + later[:, i]
            # only rows met are looked at: tables are large, and most of their rows are never met
            rows, index = np.unique(cell // k, return_inverse=True)
            counts = np.bincount(index.reshape(-1) * k + cell % k, weights[chosen], len(rows) * k).reshape(-1, k)
            visits = counts.sum(axis=1)
            row, frequency = dbn.cpt(a, i)[rows], counts / visits[:, None]
            logs = np.log(np.where(frequency > 0, frequency, 1.0)) - np.log(np.maximum(row, FLOOR))
            distance += float((visits * 0.5 * np.abs(frequency - row).sum(axis=1)).sum())
            divergence += float((visits[:, None] * frequency * logs).sum())
            total += float(visits.sum())
    return {"row_tv": distance / max(total, 1.0), "row_kl": max(0.0, divergence / max(total, 1.0))}


def unknown_code_rate(dbn: TwoSliceDBN, known: np.ndarray, samples: int = 20_000, seed: int = 0) -> float:
    """How often one step from a known code, under a random action, leads to a code that is not known.

    Args:
        dbn: the model.
        known: uint8 [C, N], distinct codes; all equally likely to be left.
        samples: steps drawn.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    codes = known[rng.integers(len(known), size=samples)]
    later = dbn.sample(codes, rng.integers(dbn.num_actions, size=samples), rng)
    _, index, _ = unique_rows(np.concatenate([known, later]))
    return float(1.0 - np.isin(index[len(known) :], index[: len(known)]).mean())
