"""The compiled rules against a plain reference and against Minigrid, step by step."""

from __future__ import annotations

import dataclasses
from collections import Counter

import gymnasium
import numpy as np
import pytest
from minigrid.core.world_object import Wall
from minigrid.envs.crossing import CrossingEnv

from domains.core import OUTCOMES
from domains.person_following.simulation.map_generation import generate_crossing
from domains.person_following.simulation.random_numbers import seeded_stream, stream_of, write_back
from domains.person_following.variants import parameters_of
from tests.domains.play import PLAYERS, compare_play
from tests.domains.reference import Reference

STEPS = 1500


@pytest.mark.parametrize("player", PLAYERS)
def test_paper_equals_the_reference(player):
    env = gymnasium.make("nesy/PersonFollowing-v0")
    outcomes = compare_play(env, Reference(None), player, STEPS, seed=7)
    assert sum(outcomes[name] for name in OUTCOMES[1:]) > 20
    if player == "greedy":
        assert outcomes["success"] > 10
        assert outcomes["goal hidden"] > 10
    if player == "adversarial":
        for event in ("bump", "same cell", "person waits", "person at goal", "goal hidden", "lost"):
            assert outcomes[event] > 0, event


@pytest.mark.parametrize(
    "changes",
    [
        {"size": 13, "num_crossings": 3},
        {"size": 7, "num_crossings": 2, "view_size": 7, "compare_heading": "always"},
        {"size": 9, "num_crossings": 3, "see_through_walls": False, "look_back": False, "max_steps": 23},
        {"compare_heading": "never", "keep_waiting": False, "person_rest": 4, "robot_rest": 5, "max_lost": 8},
        {"goal_patience": 4, "follow_distance": 2, "view_size": 3, "max_lost": 20},
    ],
)
def test_changed_rules_equal_the_reference(changes):
    env = gymnasium.make("nesy/PersonFollowing-v0", **changes)
    rules = {k: v for k, v in changes.items() if k not in ("size", "num_crossings")}
    compare_play(env, Reference(None, **rules), "mixed", STEPS // 2, seed=3)
    compare_play(env, Reference(None, **rules), "adversarial", STEPS // 2, seed=4)


def test_goals_within_reach_of_the_robot_equal_the_reference():
    """Maps of our own, so that the robot can enter the goal, also in the step in which the person arrives."""
    maps = []
    for goal in ((3, 1), (1, 3), (4, 1), (3, 3), (5, 2), (2, 4)):
        grid = np.zeros((7, 7), np.uint8)
        grid[[0, -1], :] = grid[:, [0, -1]] = 1
        grid[goal] = 2
        grid[4, 4] = 1
        maps.append(grid)
    env = gymnasium.make("nesy/PersonFollowing-v0", size=7, maps=np.array(maps))
    outcomes = compare_play(env, Reference(None), "adversarial", STEPS, seed=2)
    assert outcomes["agent_at_goal"] > 20
    assert outcomes["success"] > 20


@pytest.mark.parametrize("variant", ["clean", "occluded", "intent", "false_belief"])
@pytest.mark.parametrize("knows", ["map", "seen"])
def test_variants_equal_the_reference(variant, knows):
    env = gymnasium.make("nesy/PersonFollowing-v0", variant=variant, person_knows=knows)
    rules = dataclasses.asdict(parameters_of(variant, person_knows=knows))
    outcomes: Counter[str] = Counter()
    for player in ("random", "mixed", "adversarial"):
        outcomes += compare_play(env, Reference(None, **rules), player, STEPS // 2, seed=5)
    assert outcomes["success"] > 0
    assert (outcomes["false belief"] > 0) == (variant == "false_belief")


@pytest.mark.parametrize(("size", "crossings"), [(5, 1), (5, 2), (9, 0), (9, 1), (9, 2), (9, 6), (13, 3), (31, 9)])
def test_maps_equal_minigrid(size, crossings):
    original = CrossingEnv(size=size, num_crossings=crossings, obstacle_type=Wall)
    grids = np.zeros((1, size, size), np.uint8)
    kinds = np.zeros(11, np.uint8)
    kinds[[1, 2, 8]] = 0, 1, 2
    for seed in range(25):
        original.reset(seed=seed)
        stream = seeded_stream(seed)[None]
        for _ in range(3):
            generate_crossing(stream, grids, 0, crossings)
            assert (kinds[original.grid.encode()[:, :, 0]] == grids[0]).all()
            original.reset()


@pytest.mark.parametrize(
    ("size", "crossings", "width"), [(5, 1, 5), (9, 1, 5), (9, 2, 7), (9, 6, 5), (13, 3, 3), (19, 5, 5)]
)
def test_crossing_steps_equal_minigrid(size, crossings, width):
    original = CrossingEnv(size=size, num_crossings=crossings, obstacle_type=Wall, agent_view_size=width)
    changes = {"size": size, "num_crossings": crossings, "view_size": width}
    env = gymnasium.make("nesy/Crossing-v0", see_through_walls=False, **changes)
    kinds = np.zeros(11, np.uint8)
    kinds[[0, 1, 2, 8]] = 3, 0, 1, 2
    rng = np.random.default_rng(0)
    ended = 0
    for episode in range(8):
        first, _ = original.reset(seed=episode)
        observation, _ = env.reset(seed=episode)
        done = False
        while not done:
            assert (kinds[first["image"][:, :, 0]] == observation["view"]).all()
            assert observation["configuration"] == 0
            state = env.unwrapped.state()
            assert state["agent"] == (*original.agent_pos, original.agent_dir)
            expert = env.unwrapped.expert_action("goal")
            action = int(rng.integers(4)) if rng.random() < 0.6 else expert
            first, r, te, tr, _ = original.step(action)
            observation, reward, terminated, truncated, info = env.step(action)
            assert (r, te, tr) == (pytest.approx(reward), terminated, truncated)
            done = te or tr
        ended += info["outcome"] == "success"
    assert ended > 2


def test_random_stream_goes_on_where_numpy_stands():
    generator = np.random.default_rng(5)
    generator.integers(7)
    stream = stream_of(generator)
    generate_crossing(stream[None], np.zeros((1, 9, 9), np.uint8), 0, 2)
    other = np.random.default_rng(0)
    write_back(stream, other)
    again = stream_of(other)
    assert (again == stream).all()
    with pytest.raises(ValueError, match="PCG64"):
        stream_of(np.random.Generator(np.random.MT19937(0)))
