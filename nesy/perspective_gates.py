"""How good Φ is: shifted beliefs against what the other agent truly sees, and against the best possible.

A situation is a map, a pose of the own agent and a pose of the other one in its view; all situations of a variant
with listable maps count alike. The best possible belief is the posterior over true views given the own view and
the configuration, which counting the situations gives exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from domains.core import UNSEEN, WALL, Domain, DomainError, ViewGeometry
from nesy.perspective import PerspectiveShift
from nesy.walks import recalled
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import view_keys


@dataclass(frozen=True)
class Situations:
    """Distinct (own view, configuration) pairs, and the true views met with each.

    `own` uint8 [P, v, v], `configuration` int64 [P]; `pair` int64 [S] and `true` uint8 [S, v, v], `weight`
    int64 [S]: the distinct combinations of a pair with a true view, and in how many situations each occurs.
    """

    own: np.ndarray
    configuration: np.ndarray
    pair: np.ndarray
    true: np.ndarray
    weight: np.ndarray


def situations(domain: Domain, variant: str = "paper") -> Situations | None:
    """All situations of a variant of the following task; None where its maps are too many to list."""
    try:
        grids, _ = domain.maps(variant)
        place, before, action, _ = domain.transitions(variant, task="following")
    except DomainError:
        return None
    poses = action == 3  # one row per pose: the maps in order, then x, y and heading
    place, views = place[poses], before[poses]
    geometry = ViewGeometry(views.shape[1])
    unique, first, index = np.unique(view_keys(views), return_index=True, return_inverse=True)
    rows = []
    for number, grid in enumerate(grids):
        free = grid != WALL
        free[2, 2] |= int((place == number).sum()) > 4 * int(free.sum())
        cells = np.repeat(np.argwhere(free), 4, axis=0)
        here = index[place == number]
        assert len(cells) == len(here), "transitions are not in the order of the poses"
        rows.append(_pairs(cells, here, views[first], geometry))
    own, configuration, true = np.concatenate(rows, axis=1)
    size = geometry.num_configurations
    combined, weight = np.unique((own * size + configuration) * len(unique) + true, return_counts=True)
    pairs, pair = np.unique(combined // len(unique), return_inverse=True)
    distinct = views[first]
    return Situations(distinct[pairs // size], pairs % size, pair, distinct[combined % len(unique)], weight)


def _pairs(cells: np.ndarray, here: np.ndarray, views: np.ndarray, geometry: ViewGeometry) -> np.ndarray:
    """(own view, configuration, true view) int64 [3, n] of all pairs of poses of one map, the other one visible."""
    heading = np.tile(np.arange(4), len(cells) // 4)
    forward = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[heading]
    delta = cells[None] - cells[:, None]
    ahead = (delta * forward[:, None]).sum(2)
    side = delta[..., 1] * forward[:, None, 0] - delta[..., 0] * forward[:, None, 1]
    half, width = geometry.view_size // 2, geometry.view_size
    inside = (ahead >= 0) & (ahead < width) & (abs(side) <= half) & ((ahead != 0) | (side != 0))
    own, other = np.nonzero(inside)
    vx, vy = side[own, other] + half, width - 1 - ahead[own, other]
    visible = views[here[own], vx, vy] != UNSEEN
    own, other, vx, vy = own[visible], other[visible], vx[visible], vy[visible]
    configuration = geometry.encode(vx, vy, (heading[other] - heading[own] - 1) % 4)
    return np.stack([here[own], configuration, here[other]]).astype(np.int64)


def evaluate_shift(codec: SymbolicCodec, cases: Situations, planner: str = "table") -> dict[str, Any]:
    """Φ against the true views and the best possible.

    Returns:
        `shift`, `best`, `random`: for each `exact` (likeliest view right), `cells`, `cells_seen` and
        `cells_unseen` (cells that the own view does or does not show), `factors` (likeliest values right) and
        `kl` (of b~ to the code of the true view, nats, summed over factors); `reachable`, the share of situations
        with a way; `by_steps`: exact and kl of shift and best per number of imagined actions.
    """
    shifted = PerspectiveShift(codec, planner)(codec.beliefs(cases.own), cases.configuration)
    best_views, best_beliefs = _posterior(codec, cases)
    rng = np.random.default_rng(0)
    codes = rng.integers(0, codec.num_values, (len(cases.own), codec.num_factors)).astype(np.uint8)
    uniform = np.full_like(shifted.beliefs, 1.0 / codec.num_values)
    seen = _seen(cases)
    guesses = {
        "shift": (codec.views(shifted.codes), shifted.beliefs),
        "best": (best_views, best_beliefs),
        "random": (codec.views(codes), uniform),
    }
    reached = shifted.reachable[cases.pair]
    figures: dict[str, Any] = {"reachable": float(np.average(reached, weights=cases.weight))}
    steps = shifted.num_actions[cases.pair]
    by_steps: dict[str, dict[str, float]] = {}
    for name, (views, beliefs) in guesses.items():
        scores = _scores(codec, cases, views, beliefs, seen)
        weight = np.where(reached, cases.weight, 0)
        figures[name] = {
            "exact": float(np.average(scores["exact"], weights=weight)),
            "cells": float(np.average(scores["cells"], weights=weight)),
            "cells_seen": _share(scores["right_seen"], scores["seen"], weight),
            "cells_unseen": _share(scores["right_unseen"], scores["unseen"], weight),
            "factors": float(np.average(scores["factors"], weights=weight)),
            "kl": float(np.average(scores["kl"], weights=weight)),
        }
        for count in np.unique(steps[reached]):
            now = np.where(steps == count, weight, 0)
            entry = by_steps.setdefault(str(int(count)), {"share": float(now.sum() / weight.sum())})
            if name != "random":
                entry[f"exact_{name}"] = float(np.average(scores["exact"], weights=now))
                entry[f"kl_{name}"] = float(np.average(scores["kl"], weights=now))
    return {**figures, "by_steps": by_steps}


def _posterior(codec: SymbolicCodec, cases: Situations) -> tuple[np.ndarray, np.ndarray]:
    """The likeliest true view of every pair [P, v, v], and the marginals of the true codes [P, N, K]."""
    order = np.lexsort((-cases.weight, cases.pair))
    _, first = np.unique(cases.pair[order], return_index=True)
    codes = codec.codes(cases.true).astype(np.int64)
    beliefs = np.zeros((len(cases.own), codec.num_factors, codec.num_values))
    np.add.at(
        beliefs, (cases.pair[:, None], np.arange(codec.num_factors), codes), np.asarray(cases.weight, float)[:, None]
    )
    return cases.true[order][first], (beliefs / beliefs.sum(-1, keepdims=True)).astype(np.float32)


def _seen(cases: Situations) -> np.ndarray:
    """Bool [P, v, v]: cells of the other agent's view that the own view shows."""
    return recalled(cases.own, cases.configuration - 1) != UNSEEN


def _scores(
    codec: SymbolicCodec, cases: Situations, views: np.ndarray, beliefs: np.ndarray, seen: np.ndarray
) -> dict[str, np.ndarray]:
    size = len(cases.pair)
    right = (views[cases.pair] == cases.true).reshape(size, -1)
    shown = seen[cases.pair].reshape(size, -1)
    codes = codec.codes(cases.true).astype(np.int64)
    chance = np.take_along_axis(beliefs[cases.pair], codes[:, :, None], 2)[:, :, 0]
    return {
        "exact": right.all(1),
        "cells": right.mean(1),
        "right_seen": (right & shown).sum(1),
        "seen": shown.sum(1),
        "right_unseen": (right & ~shown).sum(1),
        "unseen": (~shown).sum(1),
        "factors": (beliefs[cases.pair].argmax(-1) == codes).mean(1),
        "kl": -np.log(np.maximum(chance, 1e-6)).sum(1),
    }


def _share(right: np.ndarray, all_cells: np.ndarray, weight: np.ndarray) -> float:
    total = float((all_cells * weight).sum())
    return float((right * weight).sum() / total) if total else 1.0
