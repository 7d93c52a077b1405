"""One row of the table that decides what a comparison can show: every oracle and follower on one variant."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.person_following.domain import DOMAIN
from domains.person_following.experts import LastSeenFollower
from domains.person_following.oracles.bayes import MAX_BELIEFS, BayesSearch
from domains.person_following.oracles.beliefs import Worlds
from domains.person_following.oracles.history_policies import egocentric_optimum
from domains.person_following.oracles.person_chain import person_chains
from domains.person_following.oracles.wrong_models import egocentric_full_state
from domains.person_following.simulation.batch import Batch
from domains.person_following.variants import Parameters, parameters_of

Act = Callable[[Batch, dict[str, NDArray[Any]]], NDArray[np.int64]]


def oracle_row(
    variant: str,
    discount: float | None = None,
    max_beliefs: int = MAX_BELIEFS,
    num_maps: int | None = None,
    seed: int = 0,
    **changes: Any,
) -> dict[str, Any]:
    """Full-state, Bayes and egocentric optimum and both followers on the worlds of a variant.

    Args:
        variant: name of the variant.
        discount: of the optima, by default that of the variant; returns are reported without discount.
        max_beliefs: where the Bayes search stops, whether or not its bounds have met.
        num_maps: how many maps to draw from all, equally weighted; None for all of them.
        seed: of that draw.
        changes: parameters that differ from the variant's.
    """
    parameters = parameters_of(variant, **changes)
    grids, weights = DOMAIN.maps(variant, **changes)
    if num_maps is not None and num_maps < len(grids):
        chosen = np.random.default_rng(seed).choice(len(grids), num_maps, replace=False, p=weights)
        grids, weights = grids[np.sort(chosen)], np.full(num_maps, 1.0 / num_maps)
    started = time.monotonic()
    chains = person_chains(grids, parameters)
    shares = np.repeat(weights / parameters.num_goals, parameters.num_goals)
    discount = DOMAIN.spec.discount(variant) if discount is None else discount
    worlds = Worlds(chains, shares, parameters, discount)
    row: dict[str, Any] = {"variant": variant, "changes": changes, "worlds": len(chains), "discount": discount}
    alone = np.array([(solved.total, solved.success) for solved in worlds.solved])
    row["full_state"] = _averages(alone[:, 0], alone[:, 1], shares, started)
    started = time.monotonic()
    bayes = BayesSearch(worlds, max_beliefs=max_beliefs).run()
    # gains are weighted by the probability of their world already
    row["bayes"] = _averages(bayes.gains.total, bayes.gains.success, np.ones(len(shares)), started) | {
        "lower": bayes.lower,
        "upper": bayes.upper,
        "solved": bayes.solved,
        "beliefs": bayes.beliefs,
    }
    row["egocentric"] = row["egocentric_full_state"] = None
    if parameters.goal_moves_at:
        started = time.monotonic()
        result = egocentric_optimum(grids, weights, parameters, discount)
        row["egocentric"] = _averages(result.map_return, result.map_success, shares, started)
        started = time.monotonic()
        gains = egocentric_full_state(worlds)
        row["egocentric_full_state"] = _averages(gains.total, gains.success, shares, started)
    own = np.tile(np.arange(parameters.num_goals), len(grids))
    worlds_grids = np.repeat(grids, parameters.num_goals, axis=0)
    row["greedy_follower"] = _follow(parameters, worlds_grids, own, shares, lambda batch, _: batch.expert("follower"))
    last_seen = LastSeenFollower(len(own), parameters)
    row["greedy_last_seen"] = _follow(
        parameters, worlds_grids, own, shares, lambda _, observation: last_seen.actions(observation)
    )
    return row


def _averages(
    returns: NDArray[np.float64], success: NDArray[np.float64], shares: NDArray[np.float64], started: float
) -> dict[str, Any]:
    return {
        "return": float(returns @ shares),
        "success": float(success @ shares),
        "seconds": time.monotonic() - started,
    }


def _follow(
    parameters: Parameters,
    grids: NDArray[np.uint8],
    own: NDArray[np.int64],
    shares: NDArray[np.float64],
    act: Act,
) -> dict[str, float]:
    """Return and success of a policy played once in every world."""
    started = time.monotonic()
    batch = Batch("following", len(own), parameters)
    batch.seed(list(range(len(own))))
    batch.begin_worlds(grids, own)
    running = np.ones(len(own), np.bool_)
    returns, won = np.zeros(len(own)), np.zeros(len(own), np.bool_)
    for _ in range(parameters.max_steps):
        last = batch.last
        actions = act(batch, {"view": last.robot_view, "configuration": last.configuration})
        batch.step(actions, False)
        returns += running * batch.last.reward
        won |= running & (batch.last.outcome == 1)
        running &= ~batch.last.ended
        if not running.any():
            break
    return {
        "return": float(returns @ shares),
        "success": float(won @ shares),
        "seconds": time.monotonic() - started,
    }
