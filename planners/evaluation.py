"""Playing episodes with an agent and writing down what came of them: one row per episode.

All agents meet the same maps and the same random seeds: episode e of a variant always starts alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from domains.core import OUTCOMES, Domain, DomainError
from planners.agents import Agent, Situation
from planners.perception import Perception

Columns = dict[str, np.ndarray]


def evaluation_maps(domain: Domain, variant: str, episodes: int) -> np.ndarray | None:
    """The start map of every episode, [episodes, size, size]; None where the maps cannot be listed.

    Listed maps are taken in turn where the generator draws them equally often, and otherwise in proportion.
    """
    try:
        grids, weights = domain.maps(variant)
    except DomainError:
        return None
    if np.allclose(weights, weights[0]):
        return np.asarray(grids[np.arange(episodes) % len(grids)])
    ends = np.cumsum(weights) / np.sum(weights)
    return np.asarray(grids[np.searchsorted(ends, (np.arange(episodes) + 0.5) / episodes).clip(0, len(grids) - 1)])


def evaluate(
    domain: Domain,
    variant: str,
    agent: Agent,
    perception: Perception | None,
    episodes: int,
    seed: int,
    advance: Callable[[int], None] = lambda count: None,
) -> Columns:
    """Play `episodes` episodes side by side.

    Args:
        domain: gives the environments.
        variant: of the task.
        agent: acts.
        perception: encodes for agents that need it, else None.
        episodes: how many.
        seed: of the environments; the same for all agents.
        advance: told how many more episodes have ended.

    Returns:
        Columns [episodes]: return, length, outcome (code), map_id, discounted_return, visible (share of the
        steps), distance (mean), waits (steps that the person waited), and ms (milliseconds per decision).
    """
    maps = evaluation_maps(domain, variant, episodes)
    env: Any = domain.make("following", episodes, variant=variant, seed=seed, maps=maps, cycle=True)
    observation, _ = env.reset(seed=seed)
    map_ids = np.array(env.map_ids())
    totals = {name: np.zeros(episodes) for name in ("return", "discounted_return", "visible", "distance", "waits")}
    length, outcome = np.zeros(episodes, np.int64), np.zeros(episodes, np.int64)
    spent = np.zeros(episodes)
    active = np.ones(episodes, np.bool_)
    last: np.ndarray | None = None
    factor = 1.0
    while active.any():
        person_views = env.person_views()
        started = time.perf_counter()
        percepts = None if perception is None else perception(observation, person_views)
        actions = agent.actions(Situation(env, observation, percepts, active, last))
        spent[active] += (time.perf_counter() - started) / active.sum()
        observation, reward, terminated, truncated, infos = env.step(actions)
        values = {
            "return": reward,
            "discounted_return": factor * np.asarray(reward),
            "visible": infos["visible"],
            "distance": infos["distance"],
            "waits": infos["person_waited"],
        }
        for name, value in values.items():
            totals[name][active] += np.asarray(value, np.float64)[active]
        length[active] += 1
        ended = active & (np.asarray(terminated) | np.asarray(truncated))
        outcome[ended] = np.asarray(infos["outcome_code"])[ended]
        active = active & ~ended
        factor *= 0.9
        last = np.asarray(actions)
        if ended.any():
            advance(int(ended.sum()))
    env.close()
    return {
        "return": totals["return"],
        "length": length,
        "outcome": outcome,
        "map_id": map_ids,
        "discounted_return": totals["discounted_return"],
        "visible": totals["visible"] / length,
        "distance": totals["distance"] / length,
        "waits": totals["waits"],
        "ms": 1000.0 * spent / length,
    }


def outcome_names(codes: np.ndarray) -> list[str]:
    """Names of outcome codes."""
    return [OUTCOMES[int(code)] for code in codes]
