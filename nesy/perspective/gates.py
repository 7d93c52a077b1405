"""How good Φ is: shifted beliefs against what the other agent truly sees, and against the best possible.

A situation is a map, a pose of the own agent and a pose of the other one in its view; all situations of a variant
with listable maps count alike. The best possible belief is the posterior over true views given the own view and
the configuration, which counting the situations gives exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from domains.core import ACTION_NAMES, MOST_MAPS, STAY, UNSEEN, WALL, Domain, DomainError, ViewGeometry, load_domain
from nesy.log.experience import held_out as drawn_maps
from nesy.log.experience import load_columns
from nesy.perspective.operator import PerspectiveShift, TableModel
from nesy.perspective.shortest_paths import recalled
from nesy.run_folder import RunFolder
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import view_keys
from nesy.world_model.storage import load_world_model


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
    """All situations of a variant of the following task.

    None where its maps are too many (`MOST_MAPS`) or not listed, or do not list every pose with its four headings.
    """
    if domain.spec.action_names != ACTION_NAMES or not domain.spec.has_person:
        return None
    try:
        grids, _ = domain.maps(variant)
        if len(grids) > MOST_MAPS:
            return None
        place, before, action, _ = domain.transitions(variant, task="following")
    except DomainError:
        return None
    poses = action == STAY  # one row per pose: the maps in order, then x, y and heading
    place, views = place[poses], before[poses]
    geometry = ViewGeometry(views.shape[1])
    unique, first, index = np.unique(view_keys(views), return_index=True, return_inverse=True)
    rows = []
    for number, grid in enumerate(grids):
        free = grid != WALL
        free[min(2, grid.shape[0] - 1), min(2, grid.shape[1] - 1)] |= int((place == number).sum()) > 4 * int(free.sum())
        cells = np.repeat(np.argwhere(free), 4, axis=0)
        here = index[place == number]
        if len(cells) != len(here):
            return None
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


def situations_met(views: np.ndarray, configurations: np.ndarray, person_views: np.ndarray) -> Situations | None:
    """The situations of some moments: own views [n, v, v], configurations [n], true views [n, v, v].

    None where the other agent is never in view.
    """
    seen = np.flatnonzero(configurations > 0)
    if not len(seen):
        return None
    both = np.concatenate([views[seen], person_views[seen]])
    unique, first, index = np.unique(view_keys(both), return_index=True, return_inverse=True)
    own, true = np.split(index.astype(np.int64), 2)
    size = int(configurations.max()) + 1
    combined, weight = np.unique(
        (own * size + configurations[seen].astype(np.int64)) * len(unique) + true, return_counts=True
    )
    pairs, pair = np.unique(combined // len(unique), return_inverse=True)
    distinct = both[first]
    return Situations(distinct[pairs // size], pairs % size, pair, distinct[combined % len(unique)], weight)


def evaluate_run(run: RunFolder, domain_name: str, variant: str, seed: int, held_out: float) -> dict[str, Any]:
    """Φ of a run's model, for summary.json: on all situations of the variant, or else on held-out experience.

    Args:
        run: with experience and a world model, and its 2DBN where the world model has no tables.
        domain_name: of the run.
        variant: of the domain.
        seed: of the run, which drew the held-out maps.
        held_out: share of the maps that training left out.

    Returns:
        As `evaluate_shift`, with `planner`, `situations` (how many) and `on`: `all maps` or `held-out maps`. The best
        possible is left out on held-out maps, where counting a few situations would not give it. Where the world
        model has no tables, `extracted` has the figures of the 2DBN with the planner `table`. Empty where the other
        agent is never in view.
    """
    codec = SymbolicCodec(load_world_model(run.world_model))
    cases, on = situations(load_domain(domain_name), variant), "all maps"
    if cases is None:
        columns = load_columns(run.experience, ("view", "configuration", "person_view", "map_id"))
        maps = np.unique(columns["map_id"])
        rows = np.isin(columns["map_id"], drawn_maps(maps, held_out, np.random.default_rng(seed)))
        cases = situations_met(*(columns[name][rows] for name in ("view", "configuration", "person_view")))
        on = "held-out maps"
        if cases is None:
            return {}
    planner = "network" if codec.packed() is None else "table"
    bound = on == "all maps"
    figures = {"on": on, "situations": int(cases.weight.sum()), "planner": planner}
    figures |= evaluate_shift(codec, cases, PerspectiveShift(codec, planner), bound=bound)
    if planner == "network":
        from nesy.dbn import Codebook, TwoSliceDBN

        book = Codebook.load(run.dbn)
        codes, first = np.unique(book.codes, axis=0, return_index=True)
        tables = TableModel(TwoSliceDBN.load(run.dbn), codes, book.views[first])
        extracted = evaluate_shift(codec, cases, PerspectiveShift(tables, "table"), bound=False)
        figures["extracted"] = extracted["shift"]
    return figures


def evaluate_shift(
    codec: SymbolicCodec, cases: Situations, shift: PerspectiveShift, *, bound: bool = True
) -> dict[str, Any]:
    """Φ against the true views, a random belief, and the best possible.

    Args:
        codec: encodes the views.
        cases: where to shift.
        shift: Φ.
        bound: whether `cases` hold all situations, so that counting them gives the posterior.

    Returns:
        `reachable`, the share of situations with a way; the others are left out. `shift`, `random` and, with `bound`,
        `best`: for each `exact` (likeliest view right), `cells`, `cells_seen` and `cells_unseen` (cells that the own
        view does or does not show), `factors` (likeliest values right) and `kl` (of the code of the true view from
        b~, nats, summed over factors, at most 13.8 for each). `by_steps` and `by_distance`: `share`, `exact`,
        `cells` and `kl` of each, per number of imagined actions and per cells ahead and aside.
    """
    shifted = shift(codec.beliefs(cases.own), cases.configuration)
    rng = np.random.default_rng(0)
    codes = rng.integers(0, codec.num_values, (len(cases.own), codec.num_factors)).astype(np.uint8)
    uniform = np.full_like(shifted.beliefs, 1.0 / codec.num_values)
    guesses = {
        "shift": (shift.model.views(shifted.codes), shifted.beliefs),
        "random": (codec.views(codes), uniform),
    }
    if bound:
        guesses["best"] = _posterior(codec, cases)
    reached = shifted.reachable[cases.pair]
    weight = np.where(reached, cases.weight, 0).astype(np.float64)
    side, ahead, _ = ViewGeometry(cases.own.shape[1]).relative(cases.configuration).T
    groups = {"by_steps": shifted.num_actions[cases.pair], "by_distance": (abs(side) + ahead)[cases.pair]}
    figures: dict[str, Any] = {"reachable": float(np.average(reached, weights=cases.weight))}
    figures |= {name: {} for name in groups}
    seen = _seen(cases)
    for name, (views, beliefs) in guesses.items():
        scores = _scores(codec, cases, views, beliefs, seen)
        figures[name] = {
            "exact": _mean(scores["exact"], weight),
            "cells": _mean(scores["cells"], weight),
            "cells_seen": _share(scores["right_seen"], scores["seen"], weight),
            "cells_unseen": _share(scores["right_unseen"], scores["unseen"], weight),
            "factors": _mean(scores["factors"], weight),
            "kl": _mean(scores["kl"], weight),
        }
        for group, number in groups.items():
            mass = np.bincount(number, weight)
            sums = {score: np.bincount(number, weight * scores[score]) for score in ("exact", "cells", "kl")}
            for value in np.flatnonzero(mass):
                entry = figures[group].setdefault(str(value), {"share": float(mass[value] / weight.sum())})
                entry[name] = {score: float(sums[score][value] / mass[value]) for score in sums}
    return figures


def _mean(score: np.ndarray, weight: np.ndarray) -> float:
    return float((score * weight).sum() / weight.sum()) if weight.sum() else 0.0


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
