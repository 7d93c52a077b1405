"""Players for differential tests, and the comparison of one environment with the reference."""

from __future__ import annotations

from collections import Counter

import numpy as np

from tests.domains.reference import FORWARD, LEFT, RIGHT, STAY, STEPS, Reference, astar

PLAYERS = ("random", "greedy", "mixed", "adversarial")


class Player:
    """Random, greedy, mixed or adversarial play, decided from the reference alone."""

    def __init__(self, kind: str, rng: np.random.Generator) -> None:
        self.kind, self.rng = kind, rng
        self.mode, self.left = "", 0

    def choose(self, reference: Reference) -> int:
        if self.kind == "greedy":
            return reference.greedy()
        if self.kind == "mixed":
            return reference.greedy() if self.rng.random() < 0.8 else int(self.rng.integers(4))
        if self.kind == "adversarial":
            # One trick for some steps, then following for some, so that episodes last long enough for the next.
            if self.left == 0:
                self.mode = "follow" if self.mode in TRICKS else str(self.rng.choice(list(TRICKS)))
                self.left = int(self.rng.integers(2, 12))
            self.left -= 1
            return reference.greedy() if self.mode == "follow" else TRICKS[self.mode](reference, self.left, self.rng)
        return int(self.rng.integers(4))


def _walk(reference, cell, otherwise=STAY):
    """First action of a shortest path to a cell."""
    path = astar(reference.grid, reference.agent, cell, None, False)
    return path[0] if path else otherwise


def _into_the_person(reference, left, rng):
    return _walk(reference, reference.person[:2], FORWARD)


def _away(reference, left, rng):
    """Forward where that leads away from the person, else turn."""
    x, y, h = reference.agent
    nx, ny = x + STEPS[h][0], y + STEPS[h][1]
    px, py, _ = reference.person
    gains = abs(nx - px) + abs(ny - py) > abs(x - px) + abs(y - py)
    return FORWARD if gains and reference.grid[nx][ny] != 1 else int(rng.choice([LEFT, RIGHT]))


def _in_the_way(reference, left, rng):
    """To the cell where the person will be two or so moves from now, and wait there."""
    x, y, h = reference.person
    for action in reference.plan[: 2 + left % 3]:
        if action == FORWARD:
            x, y = x + STEPS[h][0], y + STEPS[h][1]
        else:
            h = (h + (-1 if action == LEFT else 1)) % 4
    return _walk(reference, (x, y))


def _to_and_fro(reference, left, rng):
    return (LEFT, RIGHT)[left % 2] if left % 4 < 2 else (FORWARD, LEFT)[left % 2]


def _looking_away(reference, left, rng):
    """Stay near, but look elsewhere, so that the person waits."""
    return STAY if reference.configuration() == 0 else int(rng.choice([LEFT, RIGHT]))


def _at_the_goal(reference, left, rng):
    """To a cell beside the goal, and wait there: on it where the episode does not end by that."""
    gx, gy = reference.goal
    beside = [(gx + dx, gy + dy) for dx, dy in STEPS.values() if reference.grid[gx + dx][gy + dy] != 1]
    return STAY if reference.agent[:2] in beside or not beside else _walk(reference, beside[0])


def _into_the_goal(reference, left, rng):
    return _walk(reference, reference.goal)


def _on_another_goal(reference, left, rng):
    others = [goal for goal in reference.goals if goal != reference.goal]
    return _walk(reference, others[left % len(others)] if others else reference.person[:2])


def _standing(reference, left, rng):
    return STAY


TRICKS = {
    "into the person": _into_the_person,
    "away": _away,
    "in the way": _in_the_way,
    "to and fro": _to_and_fro,
    "looking away": _looking_away,
    "at the goal": _at_the_goal,
    "into the goal": _into_the_goal,
    "on another goal": _on_another_goal,
    "standing": _standing,
}


def compare_play(env, reference: Reference, kind: str, steps: int, seed: int) -> Counter[str]:
    """Play `steps` steps on both and assert that nothing differs.

    Returns how often each outcome came, and each of the events named below.
    """
    rng = np.random.default_rng(seed)
    player = Player(kind, rng)
    inner = env.unwrapped
    counts: Counter[str] = Counter()
    turn = {"draw": None}
    reference.random_turn = lambda: turn["draw"]
    begun = seeded = False
    for _ in range(steps):
        if not begun:
            observation, info = env.reset(seed=None if seeded else seed)
            seeded = begun = True
            state = inner.state()
            view, configuration = reference.reset(
                state["grid"], person=state["person"], goal=state["goal"], goals=state.get("goals")
            )
            assert state["agent"] == reference.agent
            assert state["person"] == (2, 2, 0) or env.spec.kwargs.get("variant", "paper") != "paper"
            assert observation["view"].tolist() == view
            assert observation["configuration"] == configuration
            assert info["distance"] == reference.distance()
            assert state["waiting"] == reference.waiting
            assert (state["lost"], state["t"]) == (0, 0)
        action = player.choose(reference)
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
        counts["false belief"] += reference.believed != reference.goal
        counts["bump"] += action == FORWARD and reference.relative()[:2] == (0, 1)
        counts["same cell"] += reference.relative()[:2] == (0, 0)
        counts["person waits"] += did == STAY
        counts["person at goal"] += state["person"][:2] == state["goal"]
        counts["goal hidden"] += reference.goal_hidden()
        counts["ended both ways"] += terminated and truncated
        if terminated or truncated:
            counts[outcome] += 1
            begun = False
    return counts
