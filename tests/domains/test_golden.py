"""Figures that the task's description gives, computed from the compiled rules."""

from __future__ import annotations

import numpy as np
import pytest

from domains import load_domain
from domains.person_following.simulation.map_generation import generate_crossing
from domains.person_following.simulation.random_numbers import seeded_stream


@pytest.fixture(scope="module")
def domain():
    return load_domain()


def test_maps_and_views(domain):
    maps, weights = domain.maps()
    assert maps.shape == (42, 9, 9)
    assert weights == pytest.approx(np.full(42, 1 / 42))
    assert (maps[:, 2, 2] == 1).sum() == 12
    assert len(domain.views(task="crossing")) == 732
    views = domain.views()
    assert len(views) == 958
    assert (views < 3).all()


def test_map_probabilities_are_those_of_the_generator(domain):
    maps, weights = domain.maps(size=7, num_crossings=2)
    keys = {grid.tobytes(): m for m, grid in enumerate(maps)}
    counts = np.zeros(len(maps))
    stream, grids = seeded_stream(0)[None], np.zeros((1, 7, 7), np.uint8)
    draws = 40_000
    for _ in range(draws):
        generate_crossing(stream, grids, 0, 2)
        counts[keys[grids.tobytes()]] += 1
    assert weights.sum() == pytest.approx(1.0)
    deviation = (counts - draws * weights) / np.sqrt(draws * weights)
    assert np.abs(deviation).max() < 5


def test_uncertainty_of_the_next_view(domain):
    """0.915 nats over 28,896 transitions: all maps x poses x 4 actions of the crossing task, uniform."""
    maps, _ = domain.maps()
    steps = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    half = np.arange(-2, 3)
    joint: dict[tuple[bytes, int], dict[bytes, int]] = {}

    def view(grid, x, y, h):
        f, r = steps[h], steps[(h + 1) % 4]
        padded = np.pad(grid, 4, constant_values=1)
        cells = [[padded[x + 4 + s * r[0] + a * f[0], y + 4 + s * r[1] + a * f[1]] for a in (4, 3, 2, 1, 0)]
                 for s in half]  # fmt: skip
        result = np.array(cells, np.uint8)
        result[2, 4] = 0
        return result.tobytes()

    transitions = 0
    for grid in maps:
        seen = {(x, y, h): view(grid, x, y, h) for x, y in np.argwhere(grid != 1).tolist() for h in range(4)}
        for (x, y, h), now in seen.items():
            fx, fy = x + steps[h][0], y + steps[h][1]
            after = [(x, y, (h - 1) % 4), (x, y, (h + 1) % 4), (fx, fy, h), (x, y, h)]
            if grid[fx, fy] == 1:
                after[2] = (x, y, h)
            for action, pose in enumerate(after):
                row = joint.setdefault((now, action), {})
                row[seen[pose]] = row.get(seen[pose], 0) + 1
                transitions += 1
    assert transitions == 28_896
    assert len({key for key, _ in joint}) == 732
    entropy = -sum(n / transitions * np.log(n / sum(row.values())) for row in joint.values() for n in row.values())
    assert entropy == pytest.approx(0.915, abs=0.0005)


@pytest.fixture(scope="module")
def optimum(domain):
    return domain.optimum()


def _play(env, act, episodes):
    """Mean return and success of the first `episodes` // B episodes of every environment."""
    env.reset()
    each = episodes // env.num_envs
    returns = np.zeros(env.num_envs)
    played = np.zeros(env.num_envs, np.int64)
    total = won = 0.0
    while (played < each).any():
        _, reward, terminated, truncated, infos = env.step(act(env))
        returns += reward
        done = terminated | truncated
        count = done & (played < each)
        total += returns[count].sum()
        won += (infos["outcome"][count] == "success").sum()
        returns[done] = 0
        played += done
    return total / (each * env.num_envs), won / (each * env.num_envs)


def test_full_state_optimum(optimum):
    assert optimum.mean_return == pytest.approx(90.3, abs=0.5)
    assert optimum.success == pytest.approx(0.807, abs=0.01)
    assert optimum.map_return.shape == optimum.map_success.shape == (42,)
    assert optimum.value == pytest.approx(optimum.map_value @ optimum.weights)


def test_playing_the_optimum_earns_what_it_promises(domain, optimum):
    maps, _ = domain.maps()
    env = domain.make("following", 42, maps=maps, cycle=True, seed=0, keep_waiting=False)
    env.reset()
    with pytest.raises(ValueError, match="parameters"):
        optimum.actions(env)
    env = domain.make("following", 42, maps=maps, cycle=True, seed=0)
    mean, success = _play(env, optimum.actions, 42)
    assert mean == pytest.approx(optimum.mean_return, abs=1e-9)
    assert success == pytest.approx(optimum.success)
    # Off the policy's own path the answer is solved again: after a random start it still plays well.
    env.reset()
    env.step(np.full(42, 0))
    assert set(optimum.actions(env)) <= {0, 1, 2, 3}


def test_optimum_is_at_least_every_other_policy(domain, optimum):
    maps, _ = domain.maps()
    env = domain.make("following", 42, maps=maps, cycle=True, seed=0)
    env.reset(options={"waiting": 0})
    discounted = np.zeros(42)
    running = np.ones(42, bool)
    for t in range(200):
        _, reward, terminated, truncated, _ = env.step(env.expert_actions("follower"))
        discounted += running * reward * 0.9**t
        running &= ~(terminated | truncated)
        if not running.any():
            break
    assert (discounted <= optimum.map_value + 1e-9).all()
    assert (discounted < optimum.map_value - 1e-6).any()


def test_greedy_follower(domain):
    env = domain.make("following", 100, seed=1)
    mean, success = _play(env, lambda e: e.expert_actions("follower"), 10_000)
    assert mean == pytest.approx(90.1, abs=1.1)
    assert success == pytest.approx(0.806, abs=0.012)
