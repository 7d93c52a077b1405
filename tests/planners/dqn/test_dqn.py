from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from domains.core import FORWARD, load_domain
from nesy.errors import UserError
from planners.config import DQNConfig
from planners.dqn.dqn import DQNPolicy, Training, ValueNetwork, features, train
from planners.dqn.replay_buffer import Replay, distinct
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


class SumCodec:
    """Codes from sums over the view: cheap, and telling enough to learn something."""

    num_factors, num_values, num_actions, view_size = 3, 8, 4, 5

    def codes(self, views: np.ndarray) -> np.ndarray:
        flat = views.reshape(len(views), 25).astype(np.int64)
        return np.stack([(flat * weights).sum(axis=1) % 8 for weights in np.arange(75).reshape(3, 25)], 1).astype(
            np.uint8
        )

    def beliefs(self, views: np.ndarray) -> np.ndarray:
        return np.eye(8, dtype=np.float32)[self.codes(views)]

    def views(self, codes: np.ndarray) -> np.ndarray:
        return np.zeros((len(codes), 5, 5), np.uint8)

    def packed(self) -> None:
        return None


TINY = DQNConfig(
    episodes=60, num_envs=8, hidden=(16,), batch_size=16, memory=400, warm_up=40, updates_per_step=0.5, n_step=2
)


def _trained(
    influence: str = "random", config: DQNConfig = TINY, **options: Any
) -> tuple[dict[str, Any], list[np.ndarray]]:
    codec: Any = SumCodec()
    policy, episodes = train(Training(load_domain(), codec, "paper", influence, "paper", config, 3), **options)
    return episodes, [value.detach().numpy() for value in policy.network.parameters()]


def _same(one: tuple[dict[str, Any], list[np.ndarray]], other: tuple[dict[str, Any], list[np.ndarray]]) -> bool:
    return all((one[0][name] == other[0][name]).all() for name in one[0]) and all(
        (a == b).all() for a, b in zip(one[1], other[1], strict=True)
    )


@pytest.mark.parametrize("config", [TINY, replace(TINY, prioritised=True, target_period=7)])
def test_a_stopped_training_goes_on_to_the_same_result(tmp_path: Path, config: DQNConfig) -> None:
    undisturbed = _trained(config=config)
    codec: Any = SumCodec()
    training = Training(load_domain(), codec, "paper", "random", "paper", config, 3)
    for _ in range(12):
        training.step(training.choose())
        training.learn()
    assert training.updates > 0
    training.save(tmp_path / "checkpoint.safetensors")
    training.step(training.choose())  # lost: after the checkpoint
    resumed = _trained(config=config, checkpoint=tmp_path / "checkpoint.safetensors")
    assert _same(undisturbed, resumed)


def test_a_checkpoint_of_another_training_or_a_damaged_one_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    _trained(config=replace(TINY, discount=0.5), checkpoint=path)
    assert _same(_trained(), _trained(checkpoint=path))
    path.write_bytes(path.read_bytes()[:200])
    assert _same(_trained(), _trained(checkpoint=path))


def test_training_ends_after_the_steps_it_was_given() -> None:
    config = DQNConfig(steps=640, episodes=1, num_envs=32, hidden=(8,), warm_up=320, batch_size=8)
    codec: Any = SumCodec()
    training = Training(load_domain(), codec, "full", "random", "paper", config, 0)
    told: list[int] = []
    policy, columns = train(training, SimpleNamespace(task=lambda *_: _Counting(told)))  # type: ignore[arg-type]
    assert training.steps == policy.trained["steps"] == 640
    assert len(columns["return"]) == len(training.finished) > 1  # not only the one episode
    assert columns["step"].max() <= 640
    assert sum(told) == 1  # progress counts what the settings call episodes
    assert training.updates == int(0.05 * 32 * 11)


class _Counting:
    def __init__(self, told: list[int]) -> None:
        self.told = told

    def __enter__(self) -> _Counting:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def advance(self, count: int, **_: float) -> None:
        self.told.append(count)


def test_rules_hold_while_exploring_and_acting() -> None:
    def never_forward(codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        allowed = np.ones((len(codes), 4), np.bool_)
        allowed[:, FORWARD] = False
        return allowed

    codec: Any = SumCodec()
    training = Training(load_domain(), codec, "full", "zero", "paper", TINY, 0, never_forward)
    while not training.over:
        training.step(training.choose())
        training.learn()
    assert set(np.unique(np.array(training.actions))) == {0, 1, 3}
    percepts = Percepts(np.zeros((5, 3), np.uint8), *[np.full((5, 3, 8), 1 / 8, np.float32)] * 2, np.zeros(5, np.int64))
    assert (
        training.policy().actions(percepts, never_forward(percepts.codes, percepts.configurations)) != FORWARD
    ).all()


def test_switches_of_the_published_code() -> None:
    published = DQNConfig.published(100)
    plain = _trained("perfect-information")
    for name in ("published_terminals", "published_target_start", "published_occlusion"):
        switched = replace(TINY, **{name: getattr(published, name)})
        assert not _same(plain, _trained("perfect-information", switched)), name
    assert published.published_sampling
    assert not _same(plain, _trained("perfect-information", replace(TINY, fallback="mode")))
    assert not _same(plain, _trained("perfect-information", replace(TINY, target_period=5)))


def test_repeats_in_a_batch_are_found_to_the_last_bit() -> None:
    rows = np.array([[0.0, 1.0], [0.5, 2.0], [0.0, 1.0], [np.nextafter(np.float32(0.5), 1), 2.0]], np.float32)
    some, which = distinct(rows)
    assert len(some) == 3
    np.testing.assert_array_equal(some.numpy()[which.numpy()], rows)
