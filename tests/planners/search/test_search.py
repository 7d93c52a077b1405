from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pomdp_py
import pytest

from domains.classic import tiger
from domains.core import ViewGeometry
from planners.agents import Situation
from planners.config import CompareConfig, SearchConfig
from planners.explicit.pomdp import TabularPOMDP
from planners.perception import Percepts
from planners.person_following import kernels
from planners.person_following.agent import PlanningAgent
from planners.person_following.ialm_search import IALMSearch
from planners.person_following.pomdp_py_adapter import LocalEnvironment, LocalState, POUCTAgent, RobotAction, RobotAgent
from planners.person_following.qmdp import LocalQMDP, TabularQMDP
from planners.search.tree import allocate, backup, backup_best, best_by_ucb, find_child
from tests.planners.person_following.models import N, small_ialm

START = np.array([0, 0, 0, 1, 2, 2, 3, 0, 0], np.int16)
CONFIG = SearchConfig(simulations=3000, depth=3, exploration=1.0, pomdp_py_simulations=200)


def _optimum(depth: int) -> np.ndarray:
    """Q of the small model, whose reward comes with ahead = 3 (shifted): by expectimax over sampled transitions."""
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    bits = np.array([7], np.uint64)
    after, v = np.zeros_like(START), np.zeros(64, np.int16)
    transition = np.zeros((4, 5, 5))
    reward = np.zeros((4, 5))
    # Only `ahead` matters for reward; it depends on codes, so this table is an average, good enough for ranking.
    for a in range(4):
        for here in range(5):
            state = START.copy()
            state[2 * N + 1] = here
            for _ in range(1000):
                state[: 2 * N] = np.random.default_rng(int(bits[0] % 2**31)).integers(0, 2, 2 * N)
                r, _, _ = kernels.step(compiled, state, a, after, v, bits)
                transition[a, here, after[2 * N + 1]] += 1 / 1000
                reward[a, here] += r / 1000
    value = np.zeros(5)
    q = np.zeros((4, 5))
    for _ in range(depth):
        q = reward + 0.9 * transition @ value
        value = q.max(axis=0)
    return q[:, START[2 * N + 1]]


def _beliefs() -> np.ndarray:
    rng = np.random.default_rng(0)
    states = np.tile(START, (200, 1))
    states[:, : 2 * N] = rng.integers(0, 2, (200, 2 * N))
    return states


def test_search_and_pomdp_py_find_the_best_action_of_a_small_model() -> None:
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    q = _optimum(3)
    best, info = IALMSearch(model, compiled, CONFIG, np.random.default_rng(1)).plan(_beliefs())
    assert q[best] >= q.max() - 0.1
    assert sum(info["visits"]) == info["simulations"] == 3000
    assert info["max_depth"] == 3
    assert max(info["values"]) == pytest.approx(q.max(), abs=0.25)
    theirs, seen = POUCTAgent(model, compiled, CONFIG, np.random.default_rng(1)).plan(_beliefs())
    assert q[theirs] >= q.max() - 0.25
    assert seen["simulations"] == 200


def test_same_seed_same_plan_and_masks_hold() -> None:
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    runs = [IALMSearch(model, compiled, CONFIG, np.random.default_rng(3)).plan(_beliefs()) for _ in range(2)]
    assert runs[0] == runs[1]
    only = np.array([True, False, False, True])
    action, info = IALMSearch(model, compiled, CONFIG, np.random.default_rng(3)).plan(_beliefs(), only)
    assert only[action]
    assert info["visits"][1] == info["visits"][2] == 0
    theirs, seen = POUCTAgent(model, compiled, CONFIG, np.random.default_rng(3)).plan(_beliefs(), only)
    assert only[theirs]
    assert seen["visits"][1] == seen["visits"][2] == 0 < seen["visits"][3]
    for planner in (IALMSearch, POUCTAgent):
        with pytest.raises(ValueError, match="at least one allowed action"):
            planner(model, compiled, CONFIG, np.random.default_rng(3)).plan(_beliefs(), np.zeros(4, np.bool_))


def test_a_limit_of_time_holds_for_the_whole_decision() -> None:
    """However much of it has gone already: little left, few simulations; none left, as few as there can be."""
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    config = replace(CONFIG, time_limit=0.5, simulations=100_000)
    for planner in (IALMSearch, POUCTAgent):
        simulations = [
            planner(model, compiled, config, np.random.default_rng(3)).plan(_beliefs(), spent=spent)[1]["simulations"]
            for spent in (0.1, 0.5, 3.0)
        ]
        assert simulations[0] > 50 > 16 >= simulations[1] == simulations[2] > 0
    assert replace(CONFIG, time_limit=0.0).time_left(3.0) == 0.0  # no limit, whatever was spent


def test_what_comes_before_the_search_counts_as_time_spent() -> None:
    model = small_ialm(0)
    given: list[float] = []

    class Slow(PlanningAgent):
        def _belief(self, rng: np.random.Generator) -> Any:
            return SimpleNamespace(
                reset=lambda *_: time.sleep(0.02), states=None, effective=0.0, resets=0, influence=lambda: np.zeros(3)
            )

        def _planner(self, rng: np.random.Generator) -> Any:
            return SimpleNamespace(plan=lambda belief, allowed, spent: (given.append(spent) or 0, {}))

    agent = Slow("search", model, CONFIG, ViewGeometry(), 0)
    percepts = Percepts(np.zeros((2, N), np.uint8), np.zeros(0), np.zeros((2, N, 2)), np.zeros(2, np.int64))
    situation = Situation(
        SimpleNamespace(), {}, percepts, np.ones(2, np.bool_), None, None, time.perf_counter() - 100.0
    )
    agent.actions(situation)
    assert len(given) == 2
    assert all(50.02 <= spent < 99.0 for spent in given)  # half of what both share, and what the own belief took


def test_trees_get_room_by_the_time_they_are_given() -> None:
    """Clearing room for a million nodes took longer than the search itself."""
    short = CompareConfig(planner_milliseconds=5.0).search_of_cells
    assert 1000 <= short.simulations <= 10_000
    assert CompareConfig(planner_milliseconds=1000.0).search_of_cells.simulations >= 500_000
    assert CompareConfig().search_of_cells == CompareConfig().search


def test_the_tree_can_be_drawn() -> None:
    model = small_ialm(0)
    search = IALMSearch(model, kernels.compile_model(model), CONFIG, np.random.default_rng(3))
    _, info = search.plan(_beliefs())
    assert 1 < info["distinct"] <= 200
    assert "forward" in search.draw(1)
    assert search.draw(2, "svg").count("<rect") > 4
    with pytest.raises(ValueError, match="'dot' or 'svg'"):
        search.draw(1, "png")  # type: ignore[arg-type]


def test_qmdp_looks_one_step_ahead() -> None:
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    planner = LocalQMDP(model, compiled, CONFIG, np.random.default_rng(0))
    belief = np.tile(_beliefs(), (10, 1))
    action, info = planner.plan(belief)
    assert _optimum(1)[action] >= _optimum(1).max() - 0.1
    assert max(info["values"]) == pytest.approx(_optimum(1).max(), abs=0.1)
    assert planner.plan(belief, np.arange(4) == 3)[0] == 3
    explicit = TabularPOMDP(**tiger())
    best, seen = TabularQMDP(explicit).plan(explicit.start)
    assert best == 0  # knowing costs nothing tomorrow
    assert seen["upper"] == pytest.approx(-1 + 0.95 * 200, abs=1e-6)


def test_terminal_states_stay_and_earn_nothing() -> None:
    model = small_ialm(0, ends=True)
    compiled = kernels.compile_model(model)
    agent = RobotAgent(model, compiled, _beliefs(), np.random.default_rng(0))
    terminal = LocalState(START, reward=5.0, outcome=1)
    after = agent.transition_model.sample(terminal, RobotAction(0, "left"))
    assert after == terminal
    assert agent.reward_model.sample(terminal, RobotAction(0, "left"), after) == 0.0


def test_genuine_pomdp_py_classes() -> None:
    model = small_ialm(0)
    compiled = kernels.compile_model(model)
    rng = np.random.default_rng(0)
    agent = RobotAgent(model, compiled, _beliefs(), rng)
    environment = LocalEnvironment(model, compiled, LocalState(START), rng)
    assert isinstance(agent, pomdp_py.Agent)
    assert isinstance(environment, pomdp_py.Environment)
    planner = pomdp_py.POUCT(max_depth=3, num_sims=50, rollout_policy=agent.policy_model)
    action = planner.plan(agent)
    reward = environment.state_transition(action, execute=True)
    observation = agent.observation_model.sample(environment.state, action)
    agent.update_history(action, observation)
    planner.update(agent, action, observation)
    assert np.isfinite(reward)
    assert agent.observation_model.probability(observation, environment.state, action) == 1.0


def test_tree_counts_and_averages() -> None:
    tree = allocate(4, 2)
    everything = np.ones(2, np.bool_)
    assert best_by_ucb(tree, 0, 1.0, everything) == 0
    made = find_child(tree, 0, 0, 99, True)
    assert made == -2  # node 1, new
    assert find_child(tree, 0, 0, 99, True) == 1
    assert find_child(tree, 0, 1, 99, False) < -1000
    nodes, actions = np.array([0, 1]), np.array([0, 1])
    value = backup(tree, nodes, actions, np.array([1.0, 2.0]), 2, 4.0, 0.5)
    assert value == 1.0 + 0.5 * (2.0 + 0.5 * 4.0)
    backup(tree, nodes, actions, np.array([3.0, 0.0]), 1, 0.0, 0.5)
    assert tree.q_value[0, 0] == pytest.approx((3.0 + 3.0) / 2)
    assert tree.q_visits[0].tolist() == [2, 0]
    assert best_by_ucb(tree, 0, 1.0, everything) == 1
    assert find_child(tree, 0, 1, 1, True) == -3
    assert find_child(tree, 0, 1, 2, True) == -4
    assert find_child(tree, 0, 1, 3, True) < -1000  # full


def test_best_backup_is_bellman_over_what_was_tried() -> None:
    tree = allocate(8, 2)
    nodes, actions = np.array([0, 1]), np.array([0, 0])
    assert find_child(tree, 0, 0, 5, True) == -2
    backup_best(tree, nodes, actions, np.array([1.0, 0.0]), 1, 1, 4.0, 0.5)
    assert tree.q_value[0, 0] == 1.0 + 0.5 * 4.0
    assert find_child(tree, 1, 0, 5, True) == -3
    backup_best(tree, nodes, actions, np.array([1.0, 0.0]), 2, 2, 2.0, 0.5)
    assert tree.value[1] == 0.5 * 2.0  # the leaf value is forgotten once the node has an action of its own
    assert tree.q_value[0, 0] == 1.0 + 0.5 * 1.0
    assert find_child(tree, 1, 1, 5, True) == -4
    backup_best(tree, nodes, np.array([0, 1]), np.array([1.0, 10.0]), 2, 3, 2.0, 0.5)
    assert tree.value[1] == 11.0
    assert tree.q_value[0, 0] == 1.0 + 0.5 * 11.0
    backup_best(tree, nodes, np.array([1, 0]), np.array([3.0, 0.0]), 1, -1, 0.0, 0.5)
    assert tree.value[0] == 6.5
