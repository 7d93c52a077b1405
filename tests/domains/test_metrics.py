"""Metrics: every name documented, and values that a plain count along the same episodes confirms."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from domains import load_domain
from domains.core import StepRecorder
from domains.person_following.metrics import BELIEF_METRICS, METRICS


def test_every_metric_is_documented():
    text = Path("docs/metrics.md").read_text(encoding="utf-8")
    assert [name for name in (*METRICS, *BELIEF_METRICS) if f"`{name}`" not in text] == []


def test_the_page_works_as_printed():
    page = Path("docs/metrics.md").read_text(encoding="utf-8")
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(compile(block, "docs/metrics.md", "exec"), names)
    assert set(METRICS) < set(names["metrics"])
    assert len(names["metrics"]["spl"]) > 64


def _record(env, player, steps, rng):
    """Play, and return the recorded steps beside what a plain observer saw of every finished episode."""
    env.reset()
    count = env.num_envs
    recorder = StepRecorder(env)
    running, finished = [[] for _ in range(count)], [[] for _ in range(count)]
    for _ in range(steps):
        expert, random = env.expert_actions("follower"), rng.integers(0, 4, count)
        actions = expert if player == "follower" else random
        if player == "mixed":
            actions = np.where(rng.random(count) < 0.8, expert, random)
        before = env.states()
        _, rewards, terminated, truncated, infos = env.step(actions)
        recorder.step(actions, rewards, infos, {"luck": actions + 0.5})
        for b in range(count):
            seen = {key: infos[key][b] for key in _KEYS}
            running[b].append((before[b], int(actions[b]), rewards[b], seen, infos["final_relative_pose"][b]))
            if terminated[b] or truncated[b]:
                finished[b].append(running[b])
                running[b] = []
    return recorder.steps(), finished


@pytest.mark.parametrize("player", ["follower", "random", "mixed"])
@pytest.mark.parametrize(
    ("variant", "changes"), [("paper", {}), ("intent", {"size": 7, "max_lost": 20, "max_steps": 30})]
)
def test_metrics_equal_a_plain_count(player, variant, changes):
    domain = load_domain()
    env = domain.make("following", 8, variant, seed=4, **changes)
    steps, finished = _record(env, player, 300, np.random.default_rng(0))
    columns = domain.episode_metrics(steps, variant, **changes)
    assert list(columns) == ["environment", "episode", *METRICS, "luck"]
    plain = [(b, k, episode) for b, episodes in enumerate(finished) for k, episode in enumerate(episodes)]
    assert len(plain) > 20
    assert all(len(column) == len(plain) for column in columns.values())
    rest = env.parameters.robot_rest
    for e, (b, k, episode) in enumerate(plain):
        row = {name: column[e] for name, column in columns.items()}
        assert (row["environment"], row["episode"]) == (b, k)
        _check(row, episode, rest)


def test_metrics_of_nothing_are_empty():
    domain = load_domain()
    env = domain.make("following", 3, seed=0)
    env.reset()
    recorder = StepRecorder(env)
    assert all(len(column) == 0 for column in domain.episode_metrics(recorder.steps()).values())
    _, rewards, _, _, infos = env.step(np.full(3, 2))
    recorder.step(np.full(3, 2), rewards, infos)
    assert all(len(column) == 0 for column in domain.episode_metrics(recorder.steps()).values())


def test_extra_values_are_averaged_where_there_are_some():
    domain = load_domain()
    env = domain.make("following", 2, seed=0, max_steps=4, max_lost=9)
    env.reset()
    recorder = StepRecorder(env)
    for step in range(8):
        _, rewards, _, _, infos = env.step(np.full(2, 3))
        values = {"kl": np.array([step, np.nan])}
        recorder.step(np.full(2, 3), rewards, infos, values if step != 1 else None)
    columns = domain.episode_metrics(recorder.steps())
    assert columns["kl"][:2].tolist() == [pytest.approx((0 + 2 + 3) / 3), pytest.approx((4 + 5 + 6 + 7) / 4)]
    assert np.isnan(columns["kl"][2:]).all()


_KEYS = ("distance", "visible", "person_waited", "person_action", "outcome")


def _check(row, steps, rest):
    count = len(steps)
    assert row["steps"] == count
    assert row["return"] == pytest.approx(sum(step[2] for step in steps))
    outcome = steps[-1][3]["outcome"]
    assert [name for name in ("success", "agent_at_goal", "lost", "unescorted", "timeout") if row[name]] == [outcome]
    # Cells that the robot moved: from one state's pose to the next; the last move only shows in the pose's change.
    moved = sum(a[0]["agent"][:2] != b[0]["agent"][:2] for a, b in pairwise(steps))
    assert moved <= row["path_length"] <= moved + 1
    acted = [3 if rest and t % rest == 0 else step[1] for t, step in enumerate(steps, start=1)]
    turns = sum(action in (0, 1) for action in acted)
    assert row["heading_changes"] == turns
    assert row["time_not_moving"] == pytest.approx((count - turns - row["path_length"]) / count)
    assert row["person_delay"] == sum(step[3]["person_waited"] for step in steps)
    assert row["visibility"] == pytest.approx(np.mean([step[3]["visible"] for step in steps]))
    gaps = [np.abs(step[4][:2]).sum() for step in steps]
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
    for (state, *_), action in zip(steps, acted, strict=True):
        x, y, h = state["agent"]
        front = (x + (h == 0) - (h == 2), y + (h == 1) - (h == 3))
        bumps += action == 2 and front == state["person"][:2]
    assert row["robot_collisions"] == bumps
    onto = [step for step, gap in zip(steps, gaps, strict=True) if gap == 0 and step[3]["person_action"] == 2]
    assert row["person_collisions"] == len(onto)
    assert row["luck"] == pytest.approx(np.mean([step[1] + 0.5 for step in steps]))
    assert 0 <= row["spl"] <= row["success"]
    if row["success"] and not row["person_delay"] and not rest:
        assert row["spl"] == 1


def test_belief_metrics():
    codes = np.array([[0, 1], [2, 2]])
    beliefs = np.full((2, 2, 3), 1 / 3)
    beliefs[0] = np.eye(3)[[0, 1]]
    views = np.zeros((2, 5, 5), np.uint8)
    other = views.copy()
    other[1, 0, 0] = 1
    result = load_domain().belief_metrics(beliefs, codes, views, other)
    assert result["kl"] == pytest.approx([0.0, 2 * np.log(3)])
    assert result["factor_accuracy"].tolist() == [1.0, 0.0]
    assert result["exact_view"].tolist() == [1.0, 0.0]
