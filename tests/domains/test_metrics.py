"""Metrics: every name documented, and values that a plain count along the same episodes confirms."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from domains import load_domain
from domains.person_following.metrics import METRICS, EpisodeMetrics, belief_metrics


def test_every_metric_is_documented():
    text = Path("docs/metrics.md").read_text(encoding="utf-8")
    assert [name for name in METRICS if f"`{name}`" not in text] == []


@pytest.mark.parametrize("player", ["follower", "random", "mixed"])
def test_metrics_equal_a_plain_count(player):
    env = load_domain().make("following", 8, seed=4)
    env.reset()
    metrics = EpisodeMetrics(8)
    metrics.begin(env.relative_poses())
    rng = np.random.default_rng(0)
    plain = [[] for _ in range(8)]
    rows = 0
    for _ in range(400):
        expert, random = env.expert_actions("follower"), rng.integers(0, 4, 8)
        actions = expert if player == "follower" else random
        if player == "mixed":
            actions = np.where(rng.random(8) < 0.8, expert, random)
        before = env.states()
        _, rewards, terminated, truncated, infos = env.step(actions)
        after = env.states()
        done = terminated | truncated
        for b in range(8):
            plain[b].append((before[b], int(actions[b]), rewards[b], {k: infos[k][b] for k in _KEYS}))
        finished = {int(row["environment"]): row for row in metrics.step(actions, rewards, infos, env.relative_poses())}
        assert sorted(finished) == np.nonzero(done)[0].tolist()
        for b, row in finished.items():
            assert list(row)[2:] == list(METRICS)
            _check(row, plain[b])
            plain[b] = []
            rows += 1
        assert len(after) == 8
    assert rows > 20


_KEYS = ("distance", "visible", "person_waited", "person_action", "outcome", "final_relative_pose")


def _check(row, steps):
    count = len(steps)
    assert row["steps"] == count
    assert row["return"] == pytest.approx(sum(step[2] for step in steps))
    outcome = steps[-1][3]["outcome"]
    assert [name for name in ("success", "agent_at_goal", "lost", "unescorted", "timeout") if row[name]] == [outcome]
    # Cells that the robot moved: from one state's pose to the next; the last move only shows in the pose's change.
    moved = sum(a[0]["agent"][:2] != b[0]["agent"][:2] for a, b in pairwise(steps))
    assert moved <= row["path_length"] <= moved + 1
    turns = sum(step[1] in (0, 1) for step in steps)
    assert row["heading_changes"] == turns
    assert row["time_not_moving"] == pytest.approx((count - turns - row["path_length"]) / count)
    assert row["person_delay"] == sum(step[3]["person_waited"] for step in steps)
    assert row["visibility"] == pytest.approx(np.mean([step[3]["visible"] for step in steps]))
    gaps = [np.abs(step[3]["final_relative_pose"][:2]).sum() for step in steps]
    assert row["mean_distance"] == pytest.approx(np.mean(gaps))
    assert row["min_distance"] == min(gaps)
    assert row["psc"] == pytest.approx(np.mean([gap >= 2 for gap in gaps]))
    far = [step[3]["distance"] > 3 for step in steps]
    assert row["time_lost"] == pytest.approx(np.mean(far))
    spells, spell = [], 0
    for beyond in far:
        if not beyond and spell:
            spells.append(spell)
        spell = spell + 1 if beyond else 0
    assert row["recovery_time"] == pytest.approx(np.mean(spells)) if spells else np.isnan(row["recovery_time"])
    bumps = 0
    for state, action, _, _ in steps:
        x, y, h = state["agent"]
        front = (x + (h == 0) - (h == 2), y + (h == 1) - (h == 3))
        bumps += action == 2 and front == state["person"][:2]
    assert row["robot_collisions"] == bumps
    assert 0 <= row["spl"] <= row["success"]
    if row["success"] and not row["person_delay"]:
        assert row["spl"] == 1


def test_belief_metrics():
    codes = np.array([[0, 1], [2, 2]])
    beliefs = np.full((2, 2, 3), 1 / 3)
    beliefs[0] = np.eye(3)[[0, 1]]
    views = np.zeros((2, 5, 5), np.uint8)
    other = views.copy()
    other[1, 0, 0] = 1
    result = belief_metrics(beliefs, codes, views, other)
    assert result["kl"] == pytest.approx([0.0, 2 * np.log(3)])
    assert result["factor_accuracy"].tolist() == [1.0, 0.0]
    assert result["exact_view"].tolist() == [1.0, 0.0]
