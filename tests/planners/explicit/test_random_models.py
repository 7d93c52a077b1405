"""Random explicit models: exact filtering, bounds, search. NESY_RANDOM_MODELS sets how many (nightly: 10000)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pomdp_py
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planners.explicit.point_based import solve
from planners.explicit.pomdp import TabularPOMDP
from planners.explicit.pomdp_py_tabular import TabularAgent, TabularEnvironment, tabular
from planners.search.tree_search import TreeSearch

MODELS = int(os.environ.get("NESY_RANDOM_MODELS", "100"))


def random_model(seed: int) -> TabularPOMDP:
    """A model with up to 5 states: sparse or dense, with or without an end, discounts 0 to 0.95."""
    rng = np.random.default_rng(seed)
    num_states, num_actions, num_observations = (int(n) for n in rng.integers(1, (6, 5, 5)))
    concentration = float(rng.choice([0.05, 0.3, 1.0]))

    def rows(*shape: int, width: int) -> np.ndarray:
        drawn = rng.dirichlet(np.full(width, concentration), shape)
        drawn[~np.isfinite(drawn).all(axis=-1)] = np.eye(width)[0]
        return np.asarray(drawn / drawn.sum(axis=-1, keepdims=True))

    transition = rows(num_actions, num_states, width=num_states)
    observation = rows(num_actions, num_states, width=num_observations)
    reward = rng.normal(0, 10, (num_actions, num_states)).round(int(rng.integers(0, 3)))
    terminal = np.zeros(num_states, np.bool_)
    if num_states > 1 and rng.random() < 0.5:
        terminal[-1] = True
        transition[:, -1] = np.eye(num_states)[-1]
        reward[:, -1] = 0
    return TabularPOMDP(
        states=[f"s{i}" for i in range(num_states)],
        actions=[f"a{i}" for i in range(num_actions)],
        observations=[f"o{i}" for i in range(num_observations)],
        transition=list(transition),
        observation=observation,
        reward=reward,
        discount=float(rng.choice([0.0, 0.5, 0.8, 0.95])),
        start=rows(width=num_states),
        terminal=terminal,
    )


def brute_force(model: TabularPOMDP, steps: list[tuple[int, int]]) -> np.ndarray:
    """The posterior over the last state, by adding up every path of states: float64 [S]."""
    weights: dict[tuple[int, ...], float] = {(s,): float(model.start[s]) for s in range(len(model.states))}
    for action, seen in steps:
        matrix = model.transition[action].toarray()
        weights = {
            (*path, t): w * matrix[path[-1], t] * model.observation[action, t, seen]
            for path, w in weights.items()
            for t in range(len(model.states))
        }
    out = np.zeros(len(model.states))
    for path, weight in weights.items():
        out[path[-1]] += weight
    return np.asarray(out / out.sum())


@settings(max_examples=MODELS, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.integers(0, 2**31))
def test_filter_bounds_and_search(seed: int) -> None:
    model, rng = random_model(seed), np.random.default_rng(seed)
    belief, steps = model.start, []
    for _ in range(3):
        action = int(rng.integers(len(model.actions)))
        chances = model.observation_chances(belief, action)
        assert chances.sum() == pytest.approx(1.0)
        seen = int(rng.choice(len(chances), p=chances / chances.sum()))
        belief = model.update(belief, action, seen)
        steps.append((action, seen))
    assert np.allclose(belief, brute_force(model, steps), atol=1e-9)
    certificate = solve(model, gap=0.1, time_limit=5.0, max_trials=8)
    assert certificate.lower <= certificate.upper + 1e-6
    assert certificate.upper <= model.fully_observed.max(axis=0) @ model.start + 1e-6
    lower, upper = certificate.at(belief)
    assert lower <= upper + 1e-6
    for method in ("bounds", "po-uct"):
        plans = []
        for _ in range(2):
            search = TreeSearch(model, np.random.default_rng(seed), simulations=40, method=method, trials=2)
            first, info = search.plan(model.start)
            seen = int(model.observation_chances(model.start, first).argmax())
            search.update(first, seen)
            plans.append((first, info, search.plan(model.update(model.start, first, seen))))
        assert plans[0] == plans[1]
        assert info["lower"] <= info["upper"] + 1e-6
        if method == "bounds":  # both bracket the optimum, so they must overlap
            assert info["lower"] <= certificate.upper + 1e-6
            assert info["upper"] >= certificate.lower - 1e-6


def test_written_files_are_read_alike(tmp_path: Path) -> None:
    for seed in range(20):
        model = random_model(seed)
        model.to_file(tmp_path / "m.pomdp")
        again = TabularPOMDP.from_file(tmp_path / "m.pomdp")
        assert np.allclose(model.observation, again.observation)
        assert np.allclose(model.reward, again.reward)
        assert all(
            np.allclose(a.toarray(), b.toarray()) for a, b in zip(model.transition, again.transition, strict=True)
        )


def test_pomdp_py_and_back() -> None:
    model = random_model(7)
    agent = TabularAgent(model, model.start, np.random.default_rng(0))
    again = tabular(
        agent, model.discount, terminal=[pomdp_py.SimpleState(model.states[-1])] if model.terminal[-1] else ()
    )
    assert np.allclose(again.reward, model.reward)
    assert np.allclose(again.observation, model.observation)
    assert all(np.allclose(a.toarray(), b.toarray()) for a, b in zip(model.transition, again.transition, strict=True))
    environment = TabularEnvironment(model, 0, np.random.default_rng(0))
    planner = pomdp_py.POUCT(max_depth=3, num_sims=50, discount_factor=0.9, rollout_policy=agent.policy_model)
    action = planner.plan(agent)
    assert action.name in model.actions
    environment.state_transition(action, execute=True)
    seen = agent.observation_model.sample(environment.state, action)
    assert agent.observation_model.probability(seen, environment.state, action) > 0
