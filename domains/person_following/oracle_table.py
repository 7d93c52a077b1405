"""One row of the table that decides what a comparison can show: every oracle and follower on one variant."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.core import DomainError
from domains.person_following.batch import Batch
from domains.person_following.bayes import BayesSearch
from domains.person_following.beliefs import Worlds
from domains.person_following.domain import DOMAIN
from domains.person_following.experts import LastSeenFollower
from domains.person_following.person_chain import person_chains
from domains.person_following.variants import Parameters, parameters_of
from domains.person_following.wrong_models import egocentric_optimum

Act = Callable[[Batch, dict[str, NDArray[Any]]], NDArray[np.int64]]


def oracle_row(
    variant: str,
    discount: float = 0.99,
    bayes_seconds: float = 30.0,
    num_maps: int | None = None,
    seed: int = 0,
    **changes: Any,
) -> dict[str, Any]:
    """Full-state, Bayes and egocentric optimum and both followers on the worlds of a variant.

    Args:
        variant: name of the variant.
        discount: of the optima; returns are reported without discount.
        bayes_seconds: time limit of the Bayes search.
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
    worlds = Worlds(chains, shares, parameters, discount)
    row: dict[str, Any] = {"variant": variant, "changes": changes, "worlds": len(chains), "discount": discount}
    row["full_state"] = _full_state(worlds, parameters) | {"seconds": time.monotonic() - started}
    bayes = BayesSearch(worlds).run(bayes_seconds)
    row["bayes"] = {
        "return": bayes.mean_return,
        "success": bayes.success,
        "lower": bayes.lower,
        "upper": bayes.upper,
        "solved": bayes.solved,
        "beliefs": bayes.beliefs,
        "seconds": bayes.seconds,
    }
    started = time.monotonic()
    try:
        result = egocentric_optimum(worlds)
        row["egocentric"] = {"return": result.mean_return, "success": result.success}
        row["egocentric"]["seconds"] = time.monotonic() - started
    except DomainError:
        row["egocentric"] = None
    own = np.tile(np.arange(parameters.num_goals), len(grids))
    worlds_grids = np.repeat(grids, parameters.num_goals, axis=0)
    row["greedy_follower"] = _follow(parameters, worlds_grids, own, shares, lambda batch, _: batch.expert("follower"))
    last_seen = LastSeenFollower(len(own), parameters)
    row["greedy_last_seen"] = _follow(
        parameters, worlds_grids, own, shares, lambda _, observation: last_seen.actions(observation)
    )
    return row


def _full_state(worlds: Worlds, parameters: Parameters) -> dict[str, float]:
    """Undiscounted return and success of the full-state optimum, by following its policy."""
    total = success = value = 0.0
    for share, root in zip(worlds.weights, _alone(worlds), strict=True):
        stack = [(share, root)]
        value += share * worlds.value(root)
        while stack:
            weight, belief = stack.pop()
            state = belief.particles[0].tolist()
            action = int(worlds.policies[state[0]][(belief.t, *state[1:])])
            successor = worlds.step(belief, action)
            total += weight * successor.reward
            success += weight * successor.success
            for probability, after in zip(successor.probabilities, successor.beliefs, strict=True):
                for k, part in enumerate(after.weights.tolist()):
                    one = after._replace(particles=after.particles[k : k + 1], weights=np.ones(1))
                    stack.append((weight * probability * part, one))
    return {"value": value, "return": total, "success": success}


def _alone(worlds: Worlds) -> list[Any]:
    """The first belief of somebody who knows the world, for every world."""
    beliefs = {}
    for _, belief in worlds.start():
        for k, particle in enumerate(belief.particles):
            one = belief._replace(particles=belief.particles[k : k + 1], weights=np.ones(1))
            beliefs[int(particle[0])] = one
    return [beliefs[i] for i in range(len(worlds.chains))]


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
