"""The Gymnasium side: spaces, seeding, autoreset, options, bad input."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from domains import DomainError, load_domain
from domains.core import BatchedEnvironment, ViewGeometry

IDS = ("nesy/PersonFollowing-v0", "nesy/Crossing-v0")


@pytest.mark.parametrize("variant", ["paper", "clean", "occluded", "intent", "false_belief"])
def test_gymnasium_checker_passes(variant):
    for name in IDS:
        check_env(gymnasium.make(name, variant=variant, render_mode="rgb_array").unwrapped)


def test_same_seed_same_episodes():
    runs = []
    for _ in range(2):
        env = gymnasium.make("nesy/PersonFollowing-v0")
        run = [env.reset(seed=11)[0]["view"].tolist()]
        for step in range(300):
            observation, reward, terminated, truncated, info = env.step(step % 4)
            run.append((observation["view"].tolist(), int(observation["configuration"]), reward, info))
            if terminated or truncated:
                env.reset()
        runs.append(run)
    assert runs[0] == runs[1]


@pytest.mark.parametrize("task", ["following", "crossing"])
def test_batch_equals_single_environments(task):
    domain = load_domain()
    batch = domain.make(task, 6, seed=20)
    batch.reset()
    singles = [gymnasium.make(IDS[task == "crossing"]) for _ in range(6)]
    for i, single in enumerate(singles):
        single.reset(seed=20 + i)
    rng = np.random.default_rng(1)
    ended = 0
    for _ in range(600):
        actions = rng.integers(0, 4, 6)
        expert = batch.expert_actions("follower" if task == "following" else "goal")
        actions = np.where(rng.random(6) < 0.7, expert, actions)
        observation, reward, terminated, truncated, infos = batch.step(actions)
        for i, single in enumerate(singles):
            o, r, te, tr, info = single.step(int(actions[i]))
            assert (infos["final_obs"]["view"][i] == o["view"]).all()
            assert infos["final_obs"]["configuration"][i] == o["configuration"]
            assert (reward[i], terminated[i], truncated[i]) == (r, te, tr)
            assert infos["outcome"][i] == info.get("outcome", "")
            assert infos["distance"][i] == info["distance"]
            assert infos["person_waited"][i] == info["person_waited"]
            if te or tr:
                ended += 1
                o, _ = single.reset()
            assert (observation["view"][i] == o["view"]).all()
            assert observation["configuration"][i] == o["configuration"]
            state = single.unwrapped.state()
            assert (batch.states()[i]["grid"] == state["grid"]).all()
            assert batch.counters()[i].tolist() == [state["waiting"], state["lost"]]
    assert ended > 10
    assert isinstance(batch, BatchedEnvironment)


def test_make_vec_gives_the_kernel_and_obeys_gymnasium():
    env = gymnasium.make_vec(IDS[0], num_envs=3, vectorization_mode="vector_entry_point")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["view"].shape == (3, 5, 5)
    observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)


def test_final_values_describe_the_step_before_the_reset():
    env = load_domain().make("following", 32, seed=0)
    env.reset()
    checked = 0
    for _ in range(60):
        before = env.map_ids()
        _, _, terminated, truncated, infos = env.step(env.expert_actions("follower"))
        done = terminated | truncated
        assert (infos["_final_obs"] == done).all()
        assert (infos["final_person_view"][~done] == env.person_views()[~done]).all()
        assert (infos["final_relative_pose"][~done] == env.relative_poses()[~done]).all()
        assert (infos["final_counters"][~done] == env.counters()[~done]).all()
        assert (env.map_ids()[~done] == before[~done]).all()
        assert (env.person_actions()[done] == -1).all()
        assert (env.relative_poses()[done] == [1, 1, 3]).all()
        assert (env.counters()[done, 1] == 0).all()
        success = infos["outcome"] == "success"
        side, ahead, heading = infos["final_relative_pose"][success].T
        geometry = ViewGeometry()
        seen = geometry.encode(side + 2, 4 - ahead, heading)
        assert (seen == infos["final_obs"]["configuration"][success]).all()
        checked += success.sum()
    assert checked > 10


def test_maps_are_cycled_and_drawn():
    domain = load_domain()
    maps, _ = domain.maps()
    env = domain.make("crossing", 5, maps=maps, cycle=True, seed=0, max_steps=1)
    env.reset()
    for k in range(20):
        expected = maps[(np.arange(5) + k * 5) % len(maps)]
        assert (np.array([state["grid"] for state in env.states()]) == expected).all()
        env.step(np.zeros(5, np.int64))
    drawn = domain.make("crossing", 500, maps=maps[:2], seed=0)
    drawn.reset()
    share = np.mean([(state["grid"] == maps[0]).all() for state in drawn.states()])
    assert 0.4 < share < 0.6


def test_options_set_the_map_and_the_waiting_counter():
    maps, _ = load_domain().maps()
    env = gymnasium.make(IDS[0])
    env.reset(seed=0)
    for grid in maps:
        env.reset(options={"grid": grid, "waiting": 2})
        state = env.unwrapped.state()
        freed = grid.copy()
        freed[2, 2] = 0
        assert (state["grid"] == freed).all()
        assert state["waiting"] == 2
        assert (state["agent"], state["person"], state["goal"]) == ((1, 1, 0), (2, 2, 0), (7, 7))


def test_waiting_counter_lives_on_in_paper_only():
    for keep, expected in ((True, 2), (False, 0)):
        env = gymnasium.make(IDS[0], keep_waiting=keep)
        env.reset(seed=0, options={"waiting": 0})
        env.step(0)
        env.step(0)
        assert env.unwrapped.state()["waiting"] == 2
        env.reset()
        assert env.unwrapped.state()["waiting"] == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 8}, "size must be odd"),
        ({"size": 33}, "size must be odd"),
        ({"num_crossings": 7}, "num_crossings must be in 0..6"),
        ({"variant": "no-such"}, "unknown variant 'no-such'"),
        ({"colour": 1}, "unknown parameter 'colour'"),
        ({"size": 9.0}, "'size' must be int"),
        ({"look_back": 1}, "'look_back' must be bool"),
        ({"robot_rest": 1}, "robot_rest must be 0"),
        ({"compare_heading": "sometimes"}, "compare_heading must be one of"),
        ({"view_size": 4}, "view_size must be odd"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    with pytest.raises(DomainError, match=message):
        gymnasium.make(IDS[0], **arguments)


@pytest.mark.parametrize("action", [4, -1, 1.0, "forward", None, True, [0, 1]])
def test_bad_actions_leave_the_state_untouched(action):
    env = gymnasium.make(IDS[0]).unwrapped
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(DomainError):
        env.step(action)
    after = env.state()
    assert all(np.array_equal(before[key], after[key]) for key in before)


@pytest.mark.parametrize("actions", [np.zeros(2), np.zeros(3, np.int64), np.array([0, 4]), np.array([[0, 1]])])
def test_bad_batched_actions_leave_the_state_untouched(actions):
    env = load_domain().make("following", 2, seed=0)
    env.reset()
    before = env.states()
    with pytest.raises(DomainError):
        env.step(actions)
    assert str(env.states()) == str(before)


def _grid(change):
    grid = load_domain().maps()[0][0].copy()
    change(grid)
    return grid


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": np.zeros((9, 9), np.uint8)}, "border"),
        ({"grid": np.zeros((7, 7), np.uint8)}, "shape"),
        ({"grid": np.full((9, 9), 1.5)}, "whole numbers"),
        ({"grid": _grid(lambda g: g.__setitem__((7, 7), 0))}, "exactly one goal"),
        ({"grid": _grid(lambda g: g.__setitem__((slice(None), 5), 1))}, "cannot be reached"),
        ({"grid": _grid(lambda g: g.__setitem__((1, 1), 1))}, "robot"),
        ({"waiting": 3}, "waiting"),
        ({"waiting": True}, "waiting"),
        ({"map": 1}, "unknown reset option 'map'"),
    ],
)
def test_bad_options_leave_the_state_untouched(options, message):
    env = gymnasium.make(IDS[0]).unwrapped
    env.reset(seed=0)
    before, stream = env.state(), env.np_random.bit_generator.state
    with pytest.raises(DomainError, match=message):
        env.reset(options=options)
    assert str(env.state()) == str(before)
    assert env.np_random.bit_generator.state == stream


def test_other_mistakes_are_named():
    domain = load_domain()
    with pytest.raises(DomainError, match="unknown domain"):
        load_domain("chess")
    with pytest.raises(DomainError, match="unknown task"):
        domain.make("dancing", 1)
    with pytest.raises(DomainError, match="num_envs"):
        domain.make("following", 0)
    env = domain.make("crossing", 1, seed=0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1, np.int64))
    env.reset()
    with pytest.raises(DomainError, match="no person to follow"):
        env.expert_actions("follower")
    with pytest.raises(DomainError, match="unknown expert"):
        env.expert_actions("magic")


@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 3))
def test_configurations_round_trip(vx, vy, heading):
    geometry = ViewGeometry()
    configuration = int(geometry.encode(vx, vy, heading))
    assert configuration == 1 + (vx * 5 + vy) * 4 + heading
    assert [int(part) for part in geometry.decode(configuration)] == [vx, vy, heading]
    assert geometry.relative(configuration).tolist() == [vx - 2, 4 - vy, heading]
    assert geometry.relative(0).tolist() == [-1, -1, -1]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([5, 7, 9, 13]), st.lists(st.integers(0, 3), max_size=60))
def test_episodes_keep_their_invariants(seed, size, actions):
    env = gymnasium.make(IDS[0], size=size, disable_env_checker=True).unwrapped
    observation, _ = env.reset(seed=seed)
    for action in actions:
        before = env.state()
        observation, reward, terminated, truncated, info = env.step(action)
        state = env.state()
        assert env.observation_space.contains(observation)
        for who in ("agent", "person"):
            (x, y, _), (bx, by, _) = state[who], before[who]
            assert state["grid"][x, y] != 1
            assert abs(x - bx) + abs(y - by) <= 1
        assert state["t"] == before["t"] + 1
        assert (info["outcome"] == "success") == (reward > 50) if terminated else reward < 50
        assert info["visible"] == (observation["configuration"] > 0)
        if terminated or truncated:
            assert info["outcome"]
            break
        assert state["lost"] < 3


def test_what_persons_have_in_mind_is_where_the_state_has_it():
    env = load_domain().make("following", 12, variant="false_belief", seed=4)
    env.reset()
    mistaken = 0
    for step in range(40):
        for state, minds in zip(env.states(), env.person_minds(), strict=True):
            x, y, heading = state["agent"]
            fx, fy = [(1, 0), (0, 1), (-1, 0), (0, -1)][heading]
            for (side, ahead), name in zip(minds.tolist(), ("believed_goal", "goal"), strict=True):
                assert (x - side * fy + ahead * fx, y + side * fx + ahead * fy) == state[name]
            mistaken += state["believed_goal"] != state["goal"]
        env.step(np.arange(12) % 4 if step % 3 else env.expert_actions("follower"))
    assert mistaken > 0


def _vector(num_envs=4, **keywords):
    return gymnasium.make_vec(IDS[0], num_envs=num_envs, vectorization_mode="vector_entry_point", **keywords)


def test_seeds_may_leave_single_environments_as_they_are():
    plain, mixed = _vector(3), _vector(3)
    plain.reset(seed=[5, 6, 7])
    mixed.reset(seed=[5, 6, 7])
    plain.reset()  # the second episode of each generator
    expected = plain.unwrapped.map_ids()
    mixed.reset(seed=[None, 9, None])
    found = mixed.unwrapped.map_ids()
    assert found[[0, 2]].tolist() == expected[[0, 2]].tolist()
    fresh = _vector(1)
    fresh.reset(seed=9)
    assert found[1] == fresh.unwrapped.map_ids()[0]
    unseeded = _vector(2)
    unseeded.reset(seed=[1, None])
    fresh.reset(seed=1)
    assert unseeded.unwrapped.map_ids()[0] == fresh.unwrapped.map_ids()[0]


@pytest.mark.parametrize("seed", [[1], [1, None, 2], "12", [True, 1], [-1, 2], [1.5, 2], -3, 1.5, True])
def test_bad_seeds_leave_everything_as_it_was(seed):
    env = _vector(2)
    env.reset(seed=3)
    before, streams = str(env.unwrapped.states()), env.unwrapped.batch.world.stream.copy()
    with pytest.raises(DomainError, match="seed"):
        env.reset(seed=seed)
    assert str(env.unwrapped.states()) == before
    assert (env.unwrapped.batch.world.stream == streams).all()


def test_a_reset_seed_replaces_the_one_given_when_the_environment_was_made():
    env = load_domain().make("following", 2, seed=1)
    env.reset(seed=2)
    env.reset()
    other = load_domain().make("following", 2, seed=7)
    other.reset(seed=2)
    other.reset()
    assert (env.map_ids() == other.map_ids()).all()


def test_a_reset_changes_no_array_returned_before():
    env = _vector(3)
    env.reset(seed=0)
    for _ in range(3):
        observation, *_, infos = env.step(np.full(3, 2))
    kept = observation["view"].copy(), infos["final_obs"]["view"].copy(), infos["distance"].copy()
    env.reset(seed=8)
    assert (observation["view"] == kept[0]).all()
    assert (infos["final_obs"]["view"] == kept[1]).all()
    assert (infos["distance"] == kept[2]).all()


@pytest.mark.parametrize("variant", ["paper", "intent", "false_belief"])
@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_autoreset_modes_equal_single_environments(variant, mode):
    count = 5
    env = _vector(count, variant=variant, autoreset_mode=mode)
    singles = [gymnasium.make(IDS[0], variant=variant).unwrapped for _ in range(count)]
    observation, _ = env.reset(seed=30)
    for i, single in enumerate(singles):
        single.reset(seed=30 + i)
    rng, ended, begun = np.random.default_rng(0), np.zeros(count, bool), 0
    for _ in range(150):
        if mode == "Disabled" and ended.any():
            before = observation["view"].copy()
            observation, _ = env.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                assert (observation["view"][i] == singles[i].reset()[0]["view"]).all()
            assert (observation["view"][~ended] == before[~ended]).all()
            begun, ended = begun + ended.sum(), np.zeros(count, bool)
        actions = np.where(rng.random(count) < 0.6, env.unwrapped.expert_actions("follower"), rng.integers(0, 4, count))
        observation, reward, terminated, truncated, infos = env.step(actions)
        assert "final_obs" not in infos
        for i, single in enumerate(singles):
            if ended[i]:
                o, info = single.reset()
                expected = (0.0, False, False, "", info["distance"])
                begun += 1
            else:
                o, r, te, tr, info = single.step(int(actions[i]))
                expected = (r, te, tr, info.get("outcome", ""), info["distance"])
            found = (reward[i], terminated[i], truncated[i], infos["outcome"][i], infos["distance"][i])
            assert found == expected
            assert (observation["view"][i] == o["view"]).all()
            assert observation["configuration"][i] == o["configuration"]
            assert str(env.unwrapped.states()[i]) == str(single.state())
        ended = terminated | truncated
    assert begun > 10


def test_gymnasiums_wrappers_of_batches_take_the_other_modes():
    from gymnasium.wrappers.vector import FlattenObservation

    for mode in (gymnasium.vector.AutoresetMode.NEXT_STEP, gymnasium.vector.AutoresetMode.DISABLED):
        env = FlattenObservation(_vector(2, autoreset_mode=mode))
        assert env.reset(seed=0)[0].shape == (2, 25 + 101)
        assert env.step(np.zeros(2, np.int64))[0].shape == (2, 25 + 101)
    with pytest.raises(ValueError, match="autoreset"):
        FlattenObservation(_vector(2))
    with pytest.raises(DomainError, match="autoreset_mode must be one of NextStep, SameStep, Disabled"):
        _vector(2, autoreset_mode="later")


def test_disabled_asks_for_resets():
    env = _vector(2, autoreset_mode="Disabled", max_steps=1)
    env.reset(seed=0)
    env.step(np.zeros(2, np.int64))
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1\]"):
        env.step(np.zeros(2, np.int64))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[1\]"):
        env.step(np.zeros(2, np.int64))


@pytest.mark.parametrize("mask", [[1, 0], np.zeros(2, bool), np.ones(3, bool), True])
def test_bad_reset_masks_are_refused(mask):
    env = _vector(2)
    with pytest.raises(DomainError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    with pytest.raises(DomainError, match="reset_mask"):
        env.reset(options={"reset_mask": mask})


def test_ends_of_the_task_are_truncations_unless_gymnasiums_words_are_asked_for():
    for ends in ("truncated", "terminated"):
        env = gymnasium.make(IDS[0], lost_ends=ends)
        batch = _vector(64, lost_ends=ends)
        batch.reset(seed=0)
        outcomes = set()
        for step in range(60):
            _, _, terminated, truncated, infos = batch.step(np.full(64, 3 if step < 40 else 0))
            alone = np.isin(infos["outcome"], ["lost", "unescorted"])
            outcomes |= set(infos["outcome"])
            assert (terminated[alone] == (ends == "terminated")).all()
            assert (truncated[alone] == (ends == "truncated")).all()
        assert "lost" in outcomes
        env.reset(seed=0)
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step(3)
            done = terminated or truncated
        assert (terminated, truncated) == (ends == "terminated", ends == "truncated")
        assert info["outcome"] in ("lost", "unescorted")
    with pytest.raises(DomainError, match="lost_ends must be one of"):
        gymnasium.make(IDS[0], lost_ends="never")
