"""Oracles under partial observability and with wrong models, on instances small enough to check by other means."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from domains import DomainError, load_domain
from domains.person_following.oracles.bayes import BayesSearch
from domains.person_following.oracles.beliefs import Belief, Worlds
from domains.person_following.oracles.oracle_table import oracle_row
from domains.person_following.oracles.person_chain import person_chains
from domains.person_following.oracles.wrong_models import egocentric_full_state
from domains.person_following.variants import parameters_of


def _worlds(variant, discount=0.9, **changes):
    parameters = parameters_of(variant, **changes)
    grids, weights = load_domain().maps(variant, **changes)
    shares = np.repeat(weights / parameters.num_goals, parameters.num_goals)
    return Worlds(person_chains(grids, parameters), shares, parameters, discount)


def test_paper_loses_nothing_to_partial_observability():
    # No episode of a good policy comes near 60 steps; cutting it off there saves the oracles most of their time.
    worlds = _worlds("paper", max_steps=60)
    result = BayesSearch(worlds).run()
    optimum = load_domain().optimum(max_steps=60)
    assert result.solved
    assert result.lower == pytest.approx(optimum.value, abs=0.01)
    assert result.gains.total.sum() == pytest.approx(90.3, abs=0.5)
    assert result.gains.success.sum() == pytest.approx(0.807, abs=0.01)


def _brute_force(worlds, belief, depth):
    """Value of a belief by trying everything for `depth` steps, and then counting nothing more."""
    if depth == 0:
        return 0.0
    values = []
    for action in range(4):
        successor = worlds.step(belief, action)
        later = [_brute_force(worlds, after, depth - 1) for after in successor.beliefs]
        expected = sum(p * v for p, v in zip(successor.probabilities, later, strict=True))
        values.append(successor.reward + worlds.discount * expected)
    return max(values)


def test_bayes_search_equals_brute_force():
    horizon = 5
    changes = {"size": 7, "num_crossings": 1, "num_goals": 3, "max_steps": horizon, "max_lost": 2}
    worlds = _worlds("intent", **changes)
    result = BayesSearch(worlds, tolerance=1e-6).run()
    start = worlds.start()
    pairs = zip(start.probabilities, start.beliefs, strict=True)
    expected = sum(share * _brute_force(worlds, belief, horizon) for share, belief in pairs)
    assert result.lower == pytest.approx(expected, abs=1e-4)
    assert result.upper == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("variant", "changes"),
    [
        ("paper", {"size": 7, "max_steps": 60}),
        ("clean", {"size": 7, "max_steps": 60}),
        ("occluded", {"size": 7, "num_crossings": 2, "max_steps": 60}),
        ("intent", {"size": 7, "num_crossings": 1, "robot_rest": 3, "max_lost": 4, "max_steps": 60}),
        ("false_belief", {"size": 7, "num_crossings": 1, "goal_moves_at": 3, "max_lost": 5, "max_steps": 60}),
    ],
)
def test_belief_steps_equal_the_environment(variant, changes):
    """A belief that knows its world, stepped by tables, goes where the compiled rules go."""
    worlds = _worlds(variant, **changes)
    parameters = worlds.parameters
    domain = load_domain()
    grids, _ = domain.maps(variant, **changes)
    own = np.tile(np.arange(parameters.num_goals), len(grids))
    env = domain.make("following", len(own), variant, seed=0, **changes)
    env.reset()
    env.batch.begin_worlds(np.repeat(grids, parameters.num_goals, axis=0), own)
    env.batch.world.person[:, 3] = 0
    rng = np.random.default_rng(0)
    particles = np.zeros((len(own), 6), np.int32)
    particles[:, 0] = np.arange(len(own))
    particles[:, 3] = [chain.pose_index[1, 1, 0] for chain in worlds.chains]
    beliefs = [Belief(0, particles[i : i + 1], np.ones(1)) for i in range(len(own))]
    for _ in range(40):
        expert = env.expert_actions("follower")
        actions = np.where(rng.random(len(own)) < 0.7, expert, rng.integers(0, 4, len(own)))
        env.batch.step(actions, False)
        last = env.batch.last
        for i, belief in enumerate(beliefs):
            if belief is None:
                continue
            successor = worlds.step(belief, int(actions[i]))
            uncertain = len(successor.beliefs) > 1 or any(len(b.weights) > 1 for b in successor.beliefs)
            if uncertain:  # the person draws the way to turn about: the environment took one of them
                beliefs[i] = None
                continue
            assert successor.reward == pytest.approx(last.reward[i])
            assert successor.success == (last.outcome[i] == 1)
            assert (len(successor.beliefs) == 0) == bool(last.ended[i])
            beliefs[i] = successor.beliefs[0] if successor.beliefs else None
            if successor.beliefs:
                assert successor.labels == [worlds.label(last.robot_view[i], last.configuration[i])]
                _, p, w, c, _, lost = successor.beliefs[0].particles[0].tolist()
                chain = worlds.chains[i]
                assert chain.person[p].tolist() == env.batch.world.person[i, :3].tolist()
                assert chain.poses[c].tolist() == env.batch.world.robot[i, :3].tolist()
                assert [w, lost] == env.counters()[i].tolist()
                assert chain.configuration[p, c] == last.configuration[i]


def test_bounds_hold_and_orders_are_as_they_must_be():
    row = oracle_row(
        "false_belief", size=7, num_crossings=1, robot_rest=4, max_lost=3, goal_moves_at=2, max_steps=40, discount=1.0
    )
    full, bayes = row["full_state"]["return"], row["bayes"]
    assert bayes["lower"] <= bayes["upper"] + 1e-5
    assert bayes["return"] <= full + 1e-6
    for other in ("egocentric", "greedy_follower", "greedy_last_seen"):
        assert row[other]["return"] <= full + 1e-6
    assert row["greedy_last_seen"]["return"] <= bayes["return"] + 1e-6


@pytest.mark.slow
def test_presets_make_mind_reading_pay():
    """The gaps that the presets were tuned for: each at least a tenth of the full-state optimum."""
    intent = oracle_row("intent")
    best, bayes = intent["full_state"]["return"], intent["bayes"]["return"]
    reactive = max(intent["greedy_follower"]["return"], intent["greedy_last_seen"]["return"])
    assert intent["bayes"]["solved"]
    assert best - bayes > 0.1 * best
    assert bayes - reactive > 0.1 * best
    belief = oracle_row("false_belief")
    assert belief["bayes"]["solved"]
    assert belief["bayes"]["return"] - belief["egocentric"]["return"] > 0.1 * belief["full_state"]["return"]


_SMALL = {"size": 7, "num_crossings": 1, "goal_moves_at": 2, "max_steps": 30}


@pytest.fixture(scope="module")
def small_optima():
    domain = load_domain()
    optima = {name: getattr(domain, name)("false_belief", 0.95, **_SMALL) for name in _OPTIMA}
    return domain, optima


_OPTIMA = ("optimum", "bayes_optimum", "egocentric_optimum")


def test_less_knowledge_is_worth_less(small_optima):
    _, optima = small_optima
    full, bayes, egocentric = (optima[name] for name in _OPTIMA)
    assert full.value >= bayes.value - 0.02
    assert bayes.value >= egocentric.value - 0.02
    assert (bayes.map_return != egocentric.map_return).any()
    for result in (full, bayes, egocentric):
        assert result.value == pytest.approx(result.map_value @ result.weights)
        assert result.mean_return == pytest.approx(result.map_return @ result.weights)
        assert result.success == pytest.approx(result.map_success @ result.weights)


@pytest.mark.parametrize("name", _OPTIMA)
def test_policies_earn_in_the_environment_what_the_oracles_promise(small_optima, name):
    """Environments with drawn goals and automatic resets: each episode brings its own world's figure."""
    domain, optima = small_optima
    result = optima[name]
    env = domain.make("following", 12, "false_belief", seed=1, **_SMALL)
    env.reset()
    grids, _ = domain.maps("false_belief", **_SMALL)
    env_of_world = domain.make("following", 2 * len(grids), "false_belief", seed=0, **_SMALL)
    env_of_world.batch.begin_worlds(np.repeat(grids, 2, axis=0), np.tile([0, 1], len(grids)))
    worlds = {(int(m), state["goal"]): i for i, (m, state) in enumerate(
        zip(env_of_world.map_ids(), env_of_world.states(), strict=True))}  # fmt: skip
    playing = [worlds[int(m), state["goal"]] for m, state in zip(env.map_ids(), env.states(), strict=True)]
    returns, episodes = np.zeros(12), 0
    for _ in range(60):
        _, reward, terminated, truncated, infos = env.step(result.actions(env))
        returns += reward
        for b in np.nonzero(terminated | truncated)[0]:
            assert returns[b] == pytest.approx(result.map_return[playing[b]])
            assert (infos["outcome"][b] == "success") == (result.map_success[playing[b]] == 1)
            state = env.states()[b]
            playing[b], returns[b] = worlds[int(env.map_ids()[b]), state["goal"]], 0.0
            episodes += 1
    assert episodes > 30


def test_policies_that_remember_must_be_asked_at_every_step(small_optima):
    domain, optima = small_optima
    policy = optima["bayes_optimum"]
    env = domain.make("following", 3, "false_belief", seed=2, **_SMALL)
    env.reset()
    first = policy.actions(env)
    assert (policy.actions(env) == first).all()
    env.step(np.full(3, 3))  # somebody else acts: that is noticed, and no mistake
    policy.actions(env)
    env.step(np.full(3, 3))
    env.step(np.full(3, 3))
    with pytest.raises(DomainError, match="every step"):
        policy.actions(env)
    with pytest.raises(DomainError, match="parameters"):
        policy.actions(domain.make("following", 3, "false_belief", seed=2))


def test_nobody_is_mistaken_where_no_goal_moves():
    domain = load_domain()
    changes = {"size": 7, "num_crossings": 1, "max_steps": 30, "num_goals": 2}
    assert (
        domain.egocentric_optimum("intent", **changes).map_return
        == domain.bayes_optimum("intent", **changes).map_return
    ).all()


def test_egocentric_agent_is_optimal_where_nobody_is_mistaken():
    worlds = _worlds("intent", size=7, num_crossings=1, max_steps=40, max_lost=5, num_goals=2)
    result = egocentric_full_state(worlds)
    optimum = sum(
        share * worlds.value(Belief(0, np.array([[i, 0, 0, chain.pose_index[1, 1, 0], 0, 0]], np.int32), np.ones(1)))
        for i, (share, chain) in enumerate(zip(worlds.weights, worlds.chains, strict=True))
    )
    assert result.value @ worlds.weights == pytest.approx(optimum, abs=1e-4)


def test_oracles_refuse_what_they_do_not_cover():
    domain = load_domain()
    with pytest.raises(DomainError, match="num_persons"):
        domain.optimum("clean", size=7, num_persons=2)
    with pytest.raises(DomainError, match="goal_moves_at"):
        domain.optimum("false_belief", size=7, num_crossings=1, look_back=True)
    with pytest.raises(DomainError, match="too many"):
        domain.maps(size=31, num_crossings=14)
    with pytest.raises(DomainError, match="too many"):
        domain.maps(size=31, num_crossings=28)
    for oracle in (domain.optimum, domain.bayes_optimum):
        with pytest.raises(DomainError, match="discount"):
            oracle(discount=1.5)
        with pytest.raises(DomainError, match=r"51,520 worlds .* too many .* size=9"):
            oracle("occluded")
    with pytest.raises(DomainError, match="egocentric"):
        domain.egocentric_optimum("false_belief", size=7, num_crossings=1, turns_at_goal=True)
    with pytest.raises(DomainError, match="egocentric"):
        egocentric_full_state(_worlds("occluded", size=5, num_crossings=1))


def test_variants_have_the_starts_and_goals_they_promise():
    domain = load_domain()
    for variant in ("clean", "intent"):
        env = domain.make("following", 64, variant, seed=3, size=9, num_crossings=2)
        env.reset()
        for state in env.states():
            assert state["grid"][state["person"][:2]] != 1
            goals = {tuple(cell) for cell in np.argwhere(state["grid"] == 2).tolist()}
            assert state["goal"] in goals
            assert len(goals) == (4 if variant == "intent" else 1)
            if variant == "intent":
                assert set(state["goals"]) == goals
    # Every clean map of this size is solved by somebody, as its start was chosen so.
    assert domain.optimum("clean").success == pytest.approx(1.0)


def test_others_walk_free_cells_and_stand_in_the_way():
    env = load_domain().make("following", 32, "clean", seed=0, num_persons=4, max_lost=60)
    env.reset()
    moved = blocked = 0
    for _ in range(60):
        before = env.states()
        env.step(np.full(32, 2))
        for old, new in zip(before, env.states(), strict=True):
            if new["t"] != old["t"] + 1:
                continue
            for a, b in zip(old["others"], new["others"], strict=True):
                assert new["grid"][b[:2]] != 1
                assert abs(a[0] - b[0]) + abs(a[1] - b[1]) <= 1
                moved += a[:2] != b[:2]
            x, y, h = old["agent"]
            front = (x + (h == 0) - (h == 2), y + (h == 1) - (h == 3))
            if front in [other[:2] for other in old["others"]]:
                blocked += 1
                assert new["agent"] == old["agent"]
    assert moved > 1000
    assert blocked > 0
    assert len(list(itertools.chain.from_iterable(state["others"] for state in env.states()))) == 96
