from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nesy.errors import UserError
from planners.config import DQNConfig
from planners.dqn import DQNPolicy, ValueNetwork, features
from planners.memory import Replay
from planners.perception import Percepts


def _replay(rewards: list[float], done: list[bool], bootstrap: list[bool], memory: int = 10) -> Replay:
    replay = Replay(memory, 1, 1, 4)
    for t, (reward, end, goes_on) in enumerate(zip(rewards, done, bootstrap, strict=True)):
        state, after = np.array([[float(t)]]), np.array([[t + 1.0]])
        replay.add(state, np.array([t % 4]), np.array([reward]), after, None, np.array([end]), np.array([goes_on]))
    return replay


def _targets(replay: Replay, age: int, n: int) -> tuple[float, float, float]:
    _, _, total, after, factor, _ = replay.n_step(np.array([age]), np.array([0]), n, 0.5)
    return float(total[0]), float(after[0, 0]), float(factor[0])


def test_n_step_returns_by_hand() -> None:
    replay = _replay([1, 2, 4, 8, 16], [False] * 5, [True] * 5)
    assert _targets(replay, 0, 1) == (1.0, 1.0, 0.5)
    assert _targets(replay, 0, 3) == (1 + 1 + 1, 3.0, 0.125)
    assert _targets(replay, 4, 3) == (16.0, 5.0, 0.5)  # nothing newer: fewer steps, matching discount


def test_the_sum_stops_at_the_end_of_the_episode() -> None:
    terminal = _replay([1, 2, 4, 8], [False, True, False, False], [True, False, True, True])
    assert _targets(terminal, 0, 3) == (2.0, 2.0, 0.0)
    clock = _replay([1, 2, 4, 8], [False, True, False, False], [True, True, True, True])
    assert _targets(clock, 0, 3) == (2.0, 2.0, 0.25)
    assert _targets(clock, 2, 2) == (4 + 4, 4.0, 0.25)


def test_the_ring_forgets_the_oldest() -> None:
    replay = _replay([1, 2, 4, 8, 16], [False] * 5, [True] * 5, memory=3)
    assert len(replay) == 3
    assert _targets(replay, 0, 2) == (4 + 4, 4.0, 0.25)


def test_priorities_are_drawn_in_proportion() -> None:
    replay = _replay([0, 0, 0], [False] * 3, [True] * 3)
    replay.priority[:3, 0] = [1.0, 1e-9, 1.0]
    ages, _, weights = replay.draw(500, np.random.default_rng(0), prioritised=True)
    assert 1 not in ages
    assert set(ages) == {0, 2}
    assert weights.max() == 1.0


def _percepts() -> Percepts:
    rng = np.random.default_rng(0)
    beliefs = rng.random((3, 2, 4), dtype=np.float32)
    return Percepts(np.zeros((3, 2), np.uint8), beliefs, beliefs[::-1], np.array([0, 2, 4]))


def test_features_of_both_input_sets() -> None:
    percepts = _percepts()
    assert features(percepts, "paper", 5).shape == (3, 16)
    full = features(percepts, "full", 5)
    assert full.shape == (3, 21)
    assert full[:, 16:].argmax(axis=1).tolist() == [0, 2, 4]


def test_saved_policies_act_alike_and_damage_is_named(tmp_path: Path) -> None:
    config = replace(DQNConfig(), hidden=(8,))
    torch.manual_seed(0)
    policy = DQNPolicy(ValueNetwork(21, 4, config), "full", 5, config)
    path = tmp_path / "policy.safetensors"
    policy.save(path)
    again = DQNPolicy.load(path)
    assert np.array_equal(policy.values(_percepts()), again.values(_percepts()))
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(UserError, match=r"policy\.safetensors: damaged"):
        DQNPolicy.load(path)
    with pytest.raises(UserError, match="no such policy"):
        DQNPolicy.load(tmp_path / "none.safetensors")
