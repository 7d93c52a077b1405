"""What is learned where walls hide things: maps drawn on the way, beliefs on them, and values of imagined ways."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from domains.core import FORWARD, GOAL, STAY, UNSEEN, WALL, load_domain
from nesy.errors import UserError
from nesy.log.collection import collect_following
from nesy.log.experience import Experience
from planners.agents import Situation
from planners.config import SearchConfig
from planners.perception import Percepts
from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_agent import MappedAgent
from planners.person_following.structured.drawn_maps.mapped_belief import MappedBelief, views_from
from planners.person_following.structured.drawn_maps.mapped_learning import learn_mapped, walls_hide
from planners.person_following.structured.drawn_maps.mapped_model import MAX_WALK, MappedModel
from planners.person_following.structured.drawn_maps.mapped_ways import (
    features,
    ground_of,
    in_sight,
    layers_of,
    moves,
    tables_of,
)
from planners.person_following.structured.drawn_maps.mapping import FAR, note, walks_to, ways_on
from planners.person_following.structured.frames import AHEAD
from tests.planners.person_following.mind_models import CODEC

DOMAIN = load_domain("person_following")
CONFIG = SearchConfig(simulations=60, mind_depth=8)


@pytest.fixture(scope="module")
def experience(tmp_path_factory: pytest.TempPathFactory) -> Experience:
    folder = tmp_path_factory.mktemp("occluded")
    collect_following(DOMAIN, 1200, 0.3, folder, 5, variant="occluded")
    return Experience.load(folder)


@pytest.fixture(scope="module")
def model(experience: Experience) -> MappedModel:
    return learn_mapped(experience, 0.99, {"for": "tests"})


def environment(count: int, seed: int = 11) -> tuple[Any, dict[str, np.ndarray]]:
    env: Any = DOMAIN.make("following", count, variant="occluded", seed=seed)
    return env, env.reset(seed=seed)[0]


def pose_of(env: Any, observation: dict[str, np.ndarray], i: int = 0) -> np.ndarray | None:
    seen = observation["configuration"][i] > 0
    return DOMAIN.spec.geometry.relative(observation["configuration"])[i] if seen else None


def course(actions: list[int], seed: int = 4) -> tuple[list[np.ndarray], list[np.ndarray | None]]:
    """Views and poses of an episode in which the robot does `actions`."""
    env, observation = environment(1, seed)
    views, poses = [observation["view"][0].copy()], [pose_of(env, observation)]
    for action in actions:
        observation, _, terminated, truncated, _ = env.step(np.array([action]))
        assert not (terminated | truncated).any()
        views.append(observation["view"][0].copy())
        poses.append(pose_of(env, observation))
    return views, poses


def following(steps: int, seed: int = 4) -> list[int]:
    """What the expert does at first."""
    env, _ = environment(1, seed)
    actions = []
    for _ in range(steps):
        actions.append(int(env.expert_actions("follower")[0]))
        env.step(np.array(actions[-1:]))
    return actions


def true_map(model: MappedModel, grid: np.ndarray) -> np.ndarray:
    """The map as it would be if all were seen: the robot begins at (1, 1) and looks to the right."""
    kinds = model.chart.blank()
    x0, y0 = (-model.chart.origin).tolist()
    for x in range(grid.shape[0]):
        for y in range(grid.shape[1]):
            side, ahead = y - 1 + x0, x - 1 + y0
            if 0 <= side < len(kinds) and 0 <= ahead < len(kinds):
                kinds[side, ahead] = grid[x, y]
    return kinds


def test_walls_that_hide_are_noticed(experience: Experience) -> None:
    assert walls_hide(experience)
    assert not walls_hide(experience.select((experience.view != UNSEEN).all((1, 2))))


def test_maps_drawn_on_the_way_are_true(model: MappedModel) -> None:
    env, observation = environment(8)
    belief = [
        MappedBelief(model, tables_of(model), CODEC, "perspective-shift", np.random.default_rng(0)) for _ in range(8)
    ]
    active = np.ones(8, np.bool_)
    for i, one in enumerate(belief):
        one.reset(observation["view"][i], pose_of(env, observation, i))
    grids = [true_map(model, state["grid"]) for state in env.states()]
    for _ in range(12):
        actions = env.expert_actions("follower")
        observation, _, terminated, truncated, _ = env.step(actions)
        active &= ~(terminated | truncated)
        for i in np.flatnonzero(active).tolist():
            belief[i].update(int(actions[i]), observation["view"][i], pose_of(env, observation, i))
            known = (belief[i].kinds != UNSEEN) & (belief[i].kinds != GOAL) & (grids[i] != GOAL)
            assert known.sum() >= 8 and (belief[i].kinds == grids[i])[known].all()
            x, y, h = (int(v) for v in env.states()[i]["agent"])
            assert (model.chart.pose(belief[i].robot) == (y - 1, x - 1, (AHEAD + h) % 4)).all()
    assert active.any()


def test_what_is_usual_has_border_and_goal(model: MappedModel) -> None:
    usual = model.chart.usual
    assert (usual[0] == WALL).all() and (usual[:, 0] == WALL).all() and (usual == GOAL).sum() == 1


def test_sight_is_learned(model: MappedModel) -> None:
    """What is shown where, on maps that are all known: at the start, and after a few steps."""
    env, observation = environment(40, seed=123)
    tables, exact = tables_of(model), []
    grounds = [ground_of(tables, true_map(model, state["grid"])) for state in env.states()]
    for _ in range(3):
        for ground, view, state in zip(grounds, observation["view"], env.states(), strict=True):
            x, y, h = (int(v) for v in state["agent"])
            pose = model.chart.number(np.array([[y - 1, x - 1, (AHEAD + h) % 4]]))
            found = views_from(tables, ground, pose)[0]
            exact.append(
                ((found == UNSEEN) == (view == UNSEEN)).all() and (found == WALL).sum() == (view == WALL).sum()
            )
        observation, *_ = env.step(env.expert_actions("follower"))
    assert np.mean(exact) > 0.95


@cache
def _small() -> np.ndarray:
    return np.array([[1, 1, 1, 1, 1], [1, 0, 0, 0, 1], [1, 1, 1, 0, 1], [1, 0, 0, 0, 1], [1, 1, 1, 1, 1]], np.uint8)


def test_walks_are_shortest(model: MappedModel) -> None:
    chart = model.chart._replace(usual=_small())
    follows, comes = ways_on(chart, _small())
    walk, queue = np.zeros(100, np.uint8), np.zeros(100, np.int64)
    free = np.flatnonzero(np.repeat((_small() != WALL).ravel(), 4))
    for target in free[::3]:
        walks_to(comes, int(target), 40, walk, queue)
        expected = np.full(100, 255)
        expected[target] = 0
        for _ in range(40):  # Bellman-Ford
            for q in free:
                expected[q] = min(expected[q], 1 + min(expected[follows[q, m]] for m in range(FORWARD + 1)))
        assert (walk[free] == expected[free]).all()
        assert (walk[np.setdiff1d(np.arange(100), free)] == FAR).all()


def test_the_filter_equals_brute_force(model: MappedModel) -> None:
    """Every course of events one by one, on the maps that the filter had at the time."""
    actions = following(4) + [0, 0]  # at last it looks away
    views, poses = course(actions)
    tables = tables_of(model)
    belief = MappedBelief(model, tables, CODEC, "perspective-shift", np.random.default_rng(0))
    belief.reset(views[0], poses[0])
    grounds, chances, robots = [belief.ground], [belief.chances], [belief.robot]
    for action, view, pose in zip(actions, views[1:], poses[1:], strict=True):
        belief.update(action, view, pose)
        grounds.append(belief.ground)
        chances.append(belief.chances)
        robots.append(belief.robot)
    found: dict[tuple[int, int], float] = {}

    def seen(k: int, p: int) -> bool:
        visible = in_sight(model.chart, grounds[k].shows, model.chart.size, 5, robots[k], p)
        if poses[k] is None:
            return not visible
        return bool((model.chart.relative(robots[k], p) == poses[k]).all())

    def walk(k: int, weight: float, p: int, lost: int) -> None:
        if weight <= 0 or not seen(k, p):
            return
        if k == len(actions):
            found[p, lost] = found.get((p, lost), 0.0) + weight
            return
        ground, q, then = grounds[k], robots[k], robots[k + 1]
        chance = moves(tables, ground, q, actions[k], p)
        for u in range(NUM_MOVES):
            after = int(ground.follows[p, u]) if u != STAY else p
            length, queue = np.zeros(len(ground.follows), np.uint8), np.zeros(len(ground.follows), np.int64)
            walks_to(ground.comes, after, MAX_WALK, length, queue)
            far, at, enters, ahead, same = features(ground.filled, ground.follows, length, q, then, actions[k], after)
            sight = int(in_sight(model.chart, ground.shows, model.chart.size, 5, then, after))
            goes_on = model.judgement[far, sight, at, lost, enters, ahead, same, 1]
            share = (chance if then != q else 1 - chance) * chances[k][p, u] * goes_on
            walk(k + 1, weight * share, after, int(model.lost_after[far, lost]))

    for p, count in model.starts.tolist():
        walk(0, float(count), p, 0)
    total = sum(found.values())
    assert any(pose is None for pose in poses)
    expected = np.zeros_like(belief.weights)
    for (p, lost), weight in found.items():
        expected[p, lost] = weight / total
    np.testing.assert_allclose(belief.weights, expected, atol=2e-4)
    np.testing.assert_allclose(belief.influence(), belief.weights.sum(1) @ belief.chances)


def test_values_equal_expectimax(model: MappedModel) -> None:
    """V of the first layer against a plain recursion over the person's moves and the robot's best answers."""
    views, poses = course([FORWARD])
    tables = tables_of(model)
    belief = MappedBelief(model, tables, CODEC, "perspective-shift", np.random.default_rng(0))
    belief.reset(views[0], poses[0])
    people = np.flatnonzero(belief.weights.any(1))
    horizon, ground = 3, belief.ground
    layers = layers_of(tables, ground, belief.chances, people, np.ones(len(people)), belief.robot, horizon, 0.9)

    def value(i: int, q: int, lost: int) -> float:
        p = int(layers.place[i])
        walk = layers.walk[layers.row[i]]
        if walk[q] > 6:
            return 0.0
        if layers.successor[i, 0] < 0:
            sight = int(in_sight(model.chart, ground.shows, model.chart.size, 5, q, p))
            return float(model.afterwards[min(int(walk[q]), MAX_WALK), sight, lost])
        best = -np.inf
        for action in range(NUM_MOVES):
            moved, total = moves(tables, ground, q, action, p), 0.0
            for then, share in ((int(ground.follows[q, action]), moved), (q, 1 - moved)):
                if share < 0.01:
                    continue
                below = 0.0
                for m in np.flatnonzero(layers.successor[i] >= 0):
                    after, chance = int(layers.successor[i, m]), layers.chance[i, m] - below
                    below = layers.chance[i, m]
                    there, to = int(layers.place[after]), layers.walk[layers.row[after]]
                    far, at, enters, ahead, same = features(ground.filled, ground.follows, to, q, then, action, there)
                    sight = int(in_sight(model.chart, ground.shows, model.chart.size, 5, then, there))
                    reward, goes_on = model.judgement[far, sight, at, lost, enters, ahead, same]
                    later = value(after, then, int(model.lost_after[far, lost]))
                    total += share * chance * (reward + 0.9 * goes_on * later)
            best = max(best, total)
        return best

    for i in range(len(people)):
        assert layers.value[i, belief.robot, 0] == pytest.approx(value(i, belief.robot, 0), abs=1e-3)


def test_what_each_mode_takes_the_person_to_see(model: MappedModel) -> None:
    views, poses = course([FORWARD, FORWARD])
    tables = tables_of(model)
    expected = {}
    for mode in ("zero", "random", "egocentric", "perspective-shift", "perfect-information"):
        belief = MappedBelief(model, tables, CODEC, mode, np.random.default_rng(1))
        belief.reset(views[0], poses[0], np.full((5, 5), WALL, np.uint8) if mode == "perfect-information" else None)
        expected[mode] = belief.influence()
        assert expected[mode].sum() == pytest.approx(1.0)
        if mode == "perfect-information":  # told of walls all around, it has them on its map
            assert (belief.kinds == WALL).sum() > 15
    counts = model.person.moments[0]
    np.testing.assert_allclose(expected["zero"], counts / counts.sum(), atol=1e-3)  # but for the smoothing of rows
    assert np.abs(expected["random"] - expected["zero"]).max() > 0.05
    assert np.abs(expected["perspective-shift"] - expected["zero"]).max() > 0.05


def test_rules_take_moves_out(model: MappedModel) -> None:
    views, poses = course([])
    never_forward = lambda codes: np.tile([True, True, False], (len(codes), 1))  # noqa: E731
    args = (model, tables_of(model), CODEC, "perspective-shift", np.random.default_rng(0))
    belief = MappedBelief(*args, never_forward)
    belief.reset(views[0], poses[0])
    assert belief.influence()[FORWARD] == 0.0 and belief.influence().sum() == pytest.approx(1.0)


def play(model: MappedModel, count: int, influence: str = "perspective-shift") -> tuple[np.ndarray, list[int]]:
    """Outcomes of some episodes, and what was done in the first."""
    env, observation = environment(count)
    agent = MappedAgent(model, CODEC, influence, CONFIG, DOMAIN.spec.geometry, 3)
    active, outcome = np.ones(count, np.bool_), np.zeros(count, np.int64)
    last, done = None, []
    while active.any():
        codes, nothing = CODEC.codes(observation["view"]), np.zeros((count, 8, 8), np.float32)
        percepts = Percepts(codes, nothing, nothing, observation["configuration"].astype(np.int64))
        actions = agent.actions(Situation(env, observation, percepts, active, last))
        done.append(int(actions[0]))
        observation, _, terminated, truncated, infos = env.step(actions)
        ended = active & (terminated | truncated)
        outcome[ended] = infos["outcome_code"][ended]
        active, last = active & ~ended, actions
    return outcome, done


def test_it_follows_and_repeats(model: MappedModel) -> None:
    outcome, done = play(model, 6)
    assert (outcome == 1).sum() >= 5
    assert play(model, 6)[1] == done


def test_saved_and_loaded(model: MappedModel, tmp_path: Path) -> None:
    model.save(tmp_path)
    loaded = MappedModel.load(tmp_path)
    assert loaded.provenance == {"for": "tests"} and loaded.view_size == 5
    for name, table in model.tables().items():
        assert (loaded.tables()[name].moments == table.moments).all()
    np.testing.assert_array_equal(loaded.judgement, model.judgement)


@pytest.mark.parametrize("name", ["person.slot", "chart.usual", "starts", "reward.yes", "shown7.moments"])
def test_damaged_files_are_refused(model: MappedModel, tmp_path: Path, name: str) -> None:
    model.save(tmp_path)
    with np.load(tmp_path / "mapped.npz") as stored:
        arrays = {key: stored[key] for key in stored.files}
    arrays[name] = (
        arrays[name] + np.asarray(100_000).astype(arrays[name].dtype) if "moments" not in name else -arrays[name]
    )
    np.savez(tmp_path / "mapped.npz", **arrays)
    with pytest.raises(UserError):
        MappedModel.load(tmp_path)
    (tmp_path / "mapped.npz").write_bytes(b"no archive")
    with pytest.raises(UserError, match=r"mapped\.npz"):
        MappedModel.load(tmp_path)


def test_a_view_that_contradicts_leaves_the_robot_where_it_was(model: MappedModel) -> None:
    views, poses = course([1])
    belief = MappedBelief(model, tables_of(model), CODEC, "perspective-shift", np.random.default_rng(0))
    belief.reset(views[0], poses[0])
    before = belief.robot
    belief.update(1, views[0], poses[0])  # a turn after which all looks as before: it cannot have happened
    assert belief.robot == before
    belief.update(1, views[1], poses[1])
    assert belief.robot != before


def test_goals_stay_on_the_map(model: MappedModel) -> None:
    kinds, pose = model.chart.blank(), np.array([4, 4, AHEAD])
    view = np.zeros((5, 5), np.uint8)
    view[2, 1] = GOAL
    note(model.chart, kinds, view, pose)
    assert (kinds == GOAL).sum() == 1
    view[2, 1] = 0  # whoever stands on it hides it
    note(model.chart, kinds, view, pose)
    assert (kinds == GOAL).sum() == 1
