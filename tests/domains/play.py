"""Players for differential tests, and the comparison of one environment with the reference."""

from __future__ import annotations

import numpy as np

from tests.domains.reference import STEPS, Reference


def choose(player, reference: Reference, rng: np.random.Generator) -> int:
    """An action of a random, greedy, mixed or adversarial player, decided from the reference alone."""
    if player == "greedy":
        return reference.greedy()
    if player == "mixed":
        return reference.greedy() if rng.random() < 0.8 else int(rng.integers(4))
    if player == "adversarial":
        # Run into the person, onto its cell, out of its sight, and to the goal before it.
        x, y, h = reference.agent
        front = (x + STEPS[h][0], y + STEPS[h][1])
        if front == reference.person[:2] or front == reference.goal:
            return 2
        if reference.person[:2] == reference.goal and rng.random() < 0.7:
            return int(rng.choice([0, 3]))
        return reference.greedy() if rng.random() < 0.6 else int(rng.choice([0, 1, 2, 2, 3]))
    return int(rng.integers(4))


def compare_play(env, reference: Reference, player: str, steps: int, seed: int) -> dict[str, int]:
    """Play `steps` steps on both and assert that nothing differs; returns how often each outcome came."""
    rng = np.random.default_rng(seed)
    inner = env.unwrapped
    outcomes: dict[str, int] = {}
    turn = {"draw": None}
    reference.random_turn = lambda: turn["draw"]
    begun, moved = False, 0
    for _ in range(steps):
        if not begun:
            observation, info = env.reset(seed=seed if not outcomes else None)
            state = inner.state()
            view, configuration = reference.reset(
                state["grid"], person=state["person"], goal=state["goal"], goals=state.get("goals")
            )
            assert observation["view"].tolist() == view
            assert observation["configuration"] == configuration
            assert info["distance"] == reference.distance()
            assert state["waiting"] == reference.waiting
            begun = True
        action = choose(player, reference, rng)
        assert inner.expert_action("follower") == reference.greedy()
        before = inner.state()["person"]
        observation, reward, terminated, truncated, info = env.step(action)
        # The only draw of a step is the way in which the person turns about at its goal.
        after = inner.state()["person"]
        turn["draw"] = 0 if (before[2] - after[2]) % 4 == 1 else 1
        (view, configuration), r, te, tr, outcome, did = reference.step(action)
        state = inner.state()
        assert observation["view"].tolist() == view
        assert observation["configuration"] == configuration
        assert abs(reward - r) < 1e-12
        assert (terminated, truncated, info.get("outcome", "")) == (te, tr, outcome)
        assert info["distance"] == reference.distance()
        assert info["visible"] == (configuration != 0)
        assert info["person_action"] == did
        assert state["agent"] == reference.agent
        assert state["person"] == reference.person
        assert state["goal"] == reference.goal
        assert state["grid"].tolist() == reference.shown()
        if "believed_goal" in state:
            assert state["believed_goal"] == reference.believed
        if "known" in state:
            assert state["known"].tolist() == reference.known
        assert (state["waiting"], state["lost"], state["t"]) == (reference.waiting, reference.lost, reference.t)
        moved += reference.believed != reference.goal
        if terminated or truncated:
            outcomes[outcome] = outcomes.get(outcome, 0) + 1
            begun = False
    outcomes["steps of false belief"] = moved
    return outcomes
