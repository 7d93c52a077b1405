"""Playing episodes with an agent and writing down what came of them: one row per episode.

All agents meet the same maps and the same random seeds: episode e of a variant always starts alike. Where there are
rules, no agent breaks them: what an agent chooses against them is replaced.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from domains.core import OUTCOMES, STAY, Domain, DomainError, StepRecorder, completed
from planners.agents import Agent, Situation, says_something
from planners.perception import Codec, Perception, Percepts
from planners.shielding import ActionMask

Columns = dict[str, np.ndarray]
GOLDEN_RATIO = (5**0.5 - 1) / 2
UNTIMED = 2
"""Decisions at the start of an episode that are not timed: they load what is compiled, for beliefs and their update."""


def evaluation_maps(domain: Domain, variant: str, episodes: int) -> np.ndarray | None:
    """The start map of every episode, [episodes, size, size]; None where the maps cannot be listed.

    Listed maps are taken in turn where the generator draws them equally often, and otherwise in proportion, by a
    sequence that spreads evenly however far it goes (multiples of the golden ratio): the first n of a greater number
    of episodes are played on the maps of n.
    """
    try:
        grids, weights = domain.maps(variant)
    except DomainError:
        return None
    if np.allclose(weights, weights[0]):
        return np.asarray(grids[np.arange(episodes) % len(grids)])
    ends = np.cumsum(weights) / np.sum(weights)
    places = (0.5 + np.arange(episodes) * GOLDEN_RATIO) % 1.0
    return np.asarray(grids[np.searchsorted(ends, places).clip(0, len(grids) - 1)])


class Player:
    """An agent with all it needs to act: its perception, and the rules that it has to keep."""

    def __init__(
        self,
        agent: Agent,
        perception: Perception | None = None,
        mask: ActionMask | None = None,
        codec: Codec | None = None,
    ) -> None:
        """Put a player together.

        Args:
            agent: acts.
            perception: encodes for agents that need it, else None.
            mask: the rules; None without.
            codec: encodes for the rules where the agent has no perception.
        """
        self.agent, self.perception, self.mask = agent, perception, mask
        self.codec = codec if perception is None else perception.codec
        assert mask is None or self.codec is not None

    def decide(
        self, env: Any, observation: dict[str, np.ndarray], active: np.ndarray, last: np.ndarray | None
    ) -> tuple[np.ndarray, Percepts | None]:
        """Actions int64 [B] in the present situations, and what was perceived."""
        begun = time.perf_counter()
        percepts = None if self.perception is None else self.perception(observation, env.person_views())
        allowed = None
        if self.mask is not None and self.codec is not None:
            codes = self.codec.codes(observation["view"]) if percepts is None else percepts.codes
            allowed = self.mask(codes, np.asarray(observation["configuration"], np.int64))
        situation = Situation(env, observation, percepts, active, last, allowed, begun)
        actions = np.asarray(self.agent.actions(situation), np.int64)
        return (actions if allowed is None else permitted(actions, allowed)), percepts


def permitted(actions: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Actions [B]; where one is not among the allowed, bool [B, A], to stay, or else the first allowed action."""
    instead = np.where(allowed[:, STAY], STAY, allowed.argmax(axis=1))
    return np.where(allowed[np.arange(len(actions)), actions], actions, instead)


def evaluate(
    domain: Domain,
    variant: str,
    player: Player,
    episodes: int,
    seed: int,
    advance: Callable[[int], None] = lambda count: None,
) -> Columns:
    """Play `episodes` episodes side by side.

    Args:
        domain: gives the environments.
        variant: of the task.
        player: acts.
        episodes: how many.
        seed: of the environments; the same for all agents.
        advance: told how many more episodes have ended.

    Returns:
        Columns [episodes]: return, length, outcome (code), map_id, discounted_return, ms_per_decision (the first
        two left out), and every metric of the domain (docs/metrics.md); those of beliefs only for agents that
        have one of what the person sees.
    """
    domain = completed(domain)
    maps = evaluation_maps(domain, variant, episodes)
    env: Any = domain.make(domain.spec.main_task, episodes, variant=variant, seed=seed, maps=maps, cycle=True)
    observation, _ = env.reset(seed=seed)
    recorder = StepRecorder(env)
    map_ids = np.array(env.map_ids())
    discounted, spent = np.zeros(episodes), np.zeros(episodes)
    length, outcome = np.zeros(episodes, np.int64), np.zeros(episodes, np.int64)
    active = np.ones(episodes, np.bool_)
    last: np.ndarray | None = None
    factor = 1.0
    while active.any():
        started = time.perf_counter()
        actions, _ = player.decide(env, observation, active, last)
        if length.max() >= UNTIMED:
            spent[active] += (time.perf_counter() - started) / active.sum()
        beliefs = _belief_metrics(domain, player, env.person_views())
        observation, reward, terminated, truncated, infos = env.step(actions)
        recorder.step(actions, reward, infos, beliefs)
        discounted[active] += factor * np.asarray(reward)[active]
        length[active] += 1
        ended = active & (np.asarray(terminated) | np.asarray(truncated))
        outcome[ended] = np.asarray(infos["outcome_code"])[ended]
        active = active & ~ended
        factor *= domain.spec.discount(variant)
        last = actions
        if ended.any():
            advance(int(ended.sum()))
    metrics = domain.episode_metrics(recorder.steps(), variant)
    env.close()
    first = metrics["episode"] == 0  # ordered by environment; environments went on with further episodes
    return {
        **{name: values[first] for name, values in metrics.items() if name not in ("environment", "episode")},
        "length": length,
        "outcome": outcome,
        "map_id": map_ids,
        "discounted_return": discounted,
        "ms_per_decision": 1000.0 * spent / np.maximum(length - UNTIMED, 1),
    }


def _belief_metrics(domain: Domain, player: Player, person_views: np.ndarray) -> Columns:
    """How well what the agent took the person to see agrees with what it truly sees: arrays [B].

    A belief that says nothing is as far from the truth as it is, but has no most likely code: NaN there.
    """
    believed, codec = player.agent.person_belief(), player.codec
    if believed is None or codec is None:
        return {}
    coder: Any = codec
    nothing = np.where(np.isnan(believed).any(axis=(1, 2), keepdims=True), np.nan, 1.0 / believed.shape[-1])
    speaks = says_something(believed)
    held = np.where(speaks[:, None, None], believed, nothing)
    decoded = coder.views(np.nan_to_num(held).argmax(axis=-1).astype(np.uint8))
    found = domain.belief_metrics(held, coder.codes(person_views), decoded, person_views)
    return {name: value if name == "kl" else np.where(speaks, value, np.nan) for name, value in found.items()}


def outcome_names(codes: np.ndarray) -> list[str]:
    """Names of outcome codes."""
    return [OUTCOMES[int(code)] for code in codes]
