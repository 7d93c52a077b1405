"""The gates: figures that tell whether a world model is good enough to plan and reason with.

All are computed over DISTINCT views and transitions (each weighted as `Transitions` says), because figures
weighted by visits hide views that share a code. Beside each stands the limit that no model of the next view can
pass: the conditional entropy of the data, and the share that always guessing the likeliest next view gets right.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.codes.refinement import CodeBook
from nesy.world_model.distinct import Transitions
from nesy.world_model.networks import SymbolicWorldModel, WorldModel
from nesy.world_model.successors import most_probable
from nesy.world_model.tables import all_tables, log_probability

# How far a model may stay behind the limit of the data and still pass.
MARGIN_NLL, MARGIN_EXACT, MARGIN_CELLS = 0.135, 0.028, 0.01


def limits(transitions: Transitions) -> dict[str, float]:
    """What the best possible model of the next view given view and action reaches on `transitions`.

    Returns:
        `next_code_nll` (conditional entropy in nats), `next_view_exact`, `next_view_cells` (of the likeliest next
        view), and `inverse_accuracy` (of the likeliest action given both views).
    """
    t, weight = transitions, transitions.weight.astype(np.float64)
    context = t.source * t.num_actions + t.action
    order = np.lexsort((-weight, context))
    contexts, first = np.unique(context[order], return_index=True)
    place = np.searchsorted(contexts, context)
    mass = np.bincount(place, weight)
    likeliest = t.target[order][first]
    entropy = -(weight * np.log(weight / mass[place])).sum()
    same = (t.views[likeliest[place]] == t.views[t.target]).reshape(len(t), -1)
    pair = np.unique(t.source * t.num_views + t.target, return_inverse=True)[1]
    best = np.zeros(pair.max() + 1)
    np.maximum.at(best, pair, weight)
    return {
        "next_code_nll": float(entropy / weight.sum()),
        "next_view_exact": float((weight * same.all(1)).sum() / weight.sum()),
        "next_view_cells": float((weight * same.mean(1)).sum() / weight.sum()),
        "inverse_accuracy": float(best.sum() / weight.sum()),
    }


def view_gates(codec: SymbolicCodec, views: np.ndarray) -> dict[str, Any]:
    """Figures of the code alone: rebuilt views, distinct codes, values in use.

    Args:
        codec: of the model.
        views: uint8 [V, v, v], distinct.
    """
    codes = codec.codes(views)
    same = (codec.views(codes) == views).reshape(len(views), -1)
    used, perplexity = [], []
    for factor in range(codec.num_factors):
        share = np.bincount(codes[:, factor], minlength=codec.num_values) / len(codes)
        used.append(int((share > 0).sum()))
        perplexity.append(float(np.exp(-(share[share > 0] * np.log(share[share > 0])).sum())))
    return {
        "views_exact": float(same.all(1).mean()),
        "cells": float(same.mean()),
        "distinct_codes": len(np.unique(codes, axis=0)),
        "distinct_views": len(views),
        "values_used": used,
        "perplexity": perplexity,
    }


def next_gates(codec: SymbolicCodec, transitions: Transitions) -> dict[str, float]:
    """Figures of the forward and the inverse model.

    Returns:
        `next_code_nll`, `next_view_exact`, `next_view_cells`, `inverse_accuracy`.
    """
    t, weight = transitions, transitions.weight.astype(np.float64)
    codes = codec.codes(t.views)
    context, place = np.unique(t.source * t.num_actions + t.action, return_inverse=True)
    before, action = codes[context // t.num_actions], context % t.num_actions
    if isinstance(codec.model, SymbolicWorldModel):
        packed = codec.packed()
        assert packed is not None
        structure, tables = codec.model.structure(), codec.model.tables()
        nll = -log_probability(structure, tables, codes[t.source], t.action, codes[t.target], codec.num_values)
        predicted = most_probable(packed, before, action)
    else:
        marginals = codec.predict(codec.certain(before), action)
        predicted = marginals.argmax(-1).astype(np.uint8)
        taken = np.take_along_axis(marginals[place], codes[t.target][:, :, None].astype(np.int64), 2)[:, :, 0]
        nll = -np.log(np.maximum(taken, 1e-9)).sum(1)
    same = (codec.views(predicted)[place] == t.views[t.target]).reshape(len(t), -1)
    inferred = infer_actions(codec, codes[t.source], codes[t.target])
    return {
        "next_code_nll": float((weight * nll).sum() / weight.sum()),
        "next_view_exact": float((weight * same.all(1)).sum() / weight.sum()),
        "next_view_cells": float((weight * same.mean(1)).sum() / weight.sum()),
        "inverse_accuracy": float((weight * (inferred == t.action)).sum() / weight.sum()),
    }


def book_nll(book: CodeBook, counted: Transitions, asked: Transitions, place: np.ndarray, num_values: int) -> float:
    """Nats that it takes to say the next code of `asked` under tables counted from `counted`, per transition.

    Args:
        book: codes of the views of `counted`, and the structure of the tables.
        counted: what the tables are counted from.
        asked: what is to be said.
        place: int [V], the index of every view of `asked` among those of `counted`.
        num_values: K.
    """
    codes, c = book.codes, counted
    tables = all_tables(book.structure, codes[c.source], c.action, codes[c.target], c.weight, num_values)
    codes = codes[place]
    before, after = codes[asked.source], codes[asked.target]
    logs = log_probability(book.structure, tables, before, asked.action, after, num_values)
    return float(-(asked.weight * logs).sum() / asked.weight.sum())


def infer_actions(codec: SymbolicCodec, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The likeliest action int64 [E] between codes [E, N], by the inverse model."""
    model: WorldModel = codec.model
    inferred = []
    with torch.no_grad():
        for first in range(0, len(before), 8192):
            rows = slice(first, first + 8192)
            pair = [torch.as_tensor(codec.certain(codes[rows]), device=model.device()) for codes in (before, after)]
            inferred.append(model.infer_action(*pair).argmax(-1).cpu().numpy())
    return np.concatenate(inferred)


def evaluate(codec: SymbolicCodec, transitions: Transitions, views: np.ndarray | None = None) -> dict[str, Any]:
    """All gates, with `limits` and `passed` (which gates hold).

    Args:
        codec: of the model.
        transitions: for the forward and the inverse model.
        views: uint8 [V, v, v] distinct, for the code; those of `transitions` by default.
    """
    figures = {**view_gates(codec, transitions.views if views is None else views), **next_gates(codec, transitions)}
    best = limits(transitions)
    passed = {
        "views_exact": figures["views_exact"] == 1.0,
        "distinct_codes": figures["distinct_codes"] == figures["distinct_views"],
        "next_code_nll": figures["next_code_nll"] <= best["next_code_nll"] + MARGIN_NLL,
        "next_view_exact": figures["next_view_exact"] >= best["next_view_exact"] - MARGIN_EXACT,
        "next_view_cells": figures["next_view_cells"] >= best["next_view_cells"] - MARGIN_CELLS,
    }
    return {**figures, "limits": best, "passed": passed}
