"""Random explicit models: exact filtering, bounds, search. NESY_RANDOM_MODELS sets how many (nightly: 10000)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pomdp_py
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.linalg import splu

from planners.explicit.bound_kernels import flatten
from planners.explicit.informed_bound import fast_informed_bound
from planners.explicit.point_based import solve
from planners.explicit.pomdp import TabularPOMDP
from planners.explicit.pomdp_py_tabular import TabularAgent, TabularEnvironment, tabular
from planners.explicit.state_bounds import Chosen, blind_policies, bracket, optimum, process_of
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


DISCOUNTS = [0.0, 0.9, 0.999, 0.9999, 0.99999]


def deterministic_model(seed: int) -> TabularPOMDP:
    """A random model where only the start is uncertain: finitely many beliefs can come up, whatever the discount."""
    rng = np.random.default_rng(seed)
    num_states, num_actions, num_observations = (int(n) for n in rng.integers(1, (6, 4, 4)))
    transition = np.eye(num_states)[rng.integers(num_states, size=(num_actions, num_states))]
    observation = np.eye(num_observations)[rng.integers(num_observations, size=(num_actions, num_states))]
    reward = rng.normal(rng.choice([-5, 0, 5]), 10, (num_actions, num_states)) * 10.0 ** rng.integers(-6, 7)
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
        discount=float(rng.choice(DISCOUNTS)),
        start=rng.dirichlet(np.ones(num_states)),
        terminal=terminal,
    )


def policy_iteration(transition: np.ndarray, reward: np.ndarray, discount: float) -> np.ndarray:
    """Value of a finite process by dense linear systems, float64 [S]; transition [A, S, S], reward [A, S]."""
    states = np.arange(reward.shape[1])
    policy = reward.argmax(axis=0)
    while True:
        system = np.eye(len(states)) - discount * transition[policy, states]
        value = np.linalg.solve(system, reward[policy, states])
        value += np.linalg.solve(system, reward[policy, states] - system @ value)
        q = reward + discount * transition @ value
        better = q.max(axis=0) > q[policy, states] + 1e-13 * np.abs(q).max()
        if not better.any():
            return np.asarray(value)
        policy = np.where(better, q.argmax(axis=0), policy)


def value_over_beliefs(model: TabularPOMDP) -> float:
    """The optimum at the start of a model with finitely many beliefs: all of them as states of one process."""
    place: dict[bytes, int] = {}
    beliefs: list[np.ndarray] = []

    def number(belief: np.ndarray) -> int:
        key = np.round(belief, 9).tobytes()
        if key not in place:
            place[key] = len(beliefs)
            beliefs.append(belief)
        return place[key]

    number(model.start)
    moves = []
    for b, belief in enumerate(beliefs):  # grows while it is walked
        for a in range(len(model.actions)):
            for o, chance in enumerate(model.observation_chances(belief, a)):
                if chance > 0:
                    moves.append((a, b, number(model.update(belief, a, o)), chance))
    transition = np.zeros((len(model.actions), len(beliefs), len(beliefs)))
    for a, b, after, chance in moves:
        transition[a, b, after] += chance
    return float(policy_iteration(transition, model.reward @ np.stack(beliefs, axis=1), model.discount)[0])


def expectimax(model: TabularPOMDP, belief: np.ndarray, depth: int) -> float:
    """The value of the best `depth` steps from a belief."""
    if depth == 0:
        return 0.0
    return max(
        float(model.reward[a] @ belief)
        + model.discount
        * sum(
            chance * expectimax(model, model.update(belief, a, o), depth - 1)
            for o, chance in enumerate(model.observation_chances(belief, a))
            if chance > 1e-14
        )
        for a in range(len(model.actions))
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


@settings(max_examples=MODELS, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from([*DISCOUNTS, 1 - 1e-7]), st.integers(-6, 6))
def test_bounds_of_states_hold_the_solution_of_linear_systems(seed: int, discount: float, power: int) -> None:
    drawn = random_model(seed)
    model = replace(drawn, discount=discount, reward=drawn.reward * 10.0**power)
    dense = np.stack([matrix.toarray() for matrix in model.transition])
    exact = policy_iteration(dense, model.reward, discount)
    blind = np.stack([policy_iteration(dense[[a]], model.reward[[a]], discount) for a in range(len(dense))])
    scale = max(np.abs(exact).max(), np.abs(blind).max(), np.abs(model.reward).max())
    fine = scale * (1e-12 + 1e-15 / (1 - discount))  # what the reference itself may miss
    wide = scale * (5e-9 if discount < 0.9999999 else 1e-6)
    low, high = bracket(process_of(model), model.terminal)
    assert (low <= exact + fine).all()
    assert (exact <= high + fine).all()
    assert (high - low <= wide).all()
    q = model.fully_observed
    assert (q.max(axis=0) >= exact - fine).all()
    assert (q.max(axis=0) <= exact + wide).all()
    below = blind_policies(model)
    assert (below <= blind + fine).all()
    assert (below >= blind - wide).all()
    for deadline in (0.0, np.inf):  # too late, and never
        informed = fast_informed_bound(model, flatten(model), q, deadline)
        assert (informed <= q.max(axis=0)).all()
        assert (informed >= blind.max(axis=0) - fine).all()
        assert (optimum(model, deadline).max(axis=0) >= exact - fine).all()
        assert (blind_policies(model, deadline) <= blind + fine).all()


@settings(max_examples=MODELS, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.integers(0, 2**31))
def test_bounds_hold_the_value_of_every_belief_that_can_come_up(seed: int) -> None:
    model = deterministic_model(seed)
    exact = value_over_beliefs(model)
    for limits in ({"time_limit": 0.0}, {"max_trials": 4, "time_limit": 1.0}):
        found = solve(model, gap=1e-6 * abs(exact), **limits)
        fine = found.bounds.precision
        assert found.lower <= found.upper
        assert found.lower - fine <= exact <= found.upper + fine
    for method in ("bounds", "po-uct"):
        _, info = TreeSearch(model, np.random.default_rng(seed), simulations=30, method=method, trials=1).plan(
            model.start
        )
        if info["simulations"]:
            assert info["lower"] - fine <= exact <= info["upper"] + fine
    rng = np.random.default_rng(seed)
    for _ in range(5):
        lower, upper = found.at(rng.dirichlet(np.full(len(model.states), 0.5)))
        assert lower <= upper


@settings(max_examples=MODELS // 4, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.integers(0, 2**31))
def test_bounds_hold_what_looking_at_all_futures_gives(seed: int) -> None:
    drawn = random_model(seed)
    few = slice(0, 2)
    weights = drawn.observation[few, :, few] + 1e-3
    model = replace(
        drawn,
        actions=drawn.actions[few],
        observations=drawn.observations[few],
        transition=drawn.transition[few],
        observation=weights / weights.sum(axis=2, keepdims=True),
        reward=drawn.reward[few],
        discount=0.1,
    )
    exact, rest = expectimax(model, model.start, 5), np.abs(model.reward).max() * 0.1**5 / 0.9
    found = solve(model, gap=1e-4, max_trials=30)
    assert found.lower - rest - 1e-9 <= exact <= found.upper + rest + 1e-9


@pytest.mark.parametrize("discount", [0.9, 0.999, 0.99999])
@pytest.mark.parametrize("near", [False, True])
def test_bounds_of_larger_processes_are_sharp(discount: float, near: bool) -> None:
    """2,000 states whose successors are anywhere (GMRES) or near by (sparse LU), beside scipy's direct solver."""
    rng, size, num_actions = np.random.default_rng(0), 2000, 3
    matrices = []
    for _ in range(num_actions):
        to = (
            (np.arange(size)[:, None] + rng.integers(-2, 3, (size, 3))) % size
            if near
            else rng.integers(size, size=(size, 3))
        )
        entries = (rng.dirichlet(np.ones(3), size).ravel(), (np.repeat(np.arange(size), 3), to.ravel()))
        matrices.append(sparse.csr_array(entries, shape=(size, size)))
    process = Chosen(sparse.csr_array(sparse.vstack(matrices)), rng.normal(0, 1, (num_actions, size)), discount)
    low, high = bracket(process, np.zeros(size, np.bool_))
    scale = np.abs(high).max()
    assert (high - low).max() <= 1e-8 * scale
    process.apply(high)
    matrix, gain = process.system()
    exact = splu(sparse.csc_array(sparse.eye_array(size) - discount * matrix)).solve(gain)
    assert (low <= exact + 1e-8 * scale).all()
    assert (exact <= high + 1e-8 * scale).all()


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
