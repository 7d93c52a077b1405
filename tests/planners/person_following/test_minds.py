"""What is learned where minds matter: scenes, intentions, beliefs over them, and values of imagined ways."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from domains.core import FORWARD, GOAL, STAY, UNSEEN, WALL, load_domain
from nesy.errors import UserError
from nesy.log.experience import Experience
from planners.config import SearchConfig
from planners.person_following.structured.frames import learn_frame
from planners.person_following.structured.known_maps.mind_agent import MindSearch
from planners.person_following.structured.known_maps.mind_beliefs import MindBelief
from planners.person_following.structured.known_maps.mind_learning import learn_minds, several_goals
from planners.person_following.structured.known_maps.mind_walk import MindTree, mind_advance
from planners.person_following.structured.known_maps.minds import MAX_WALK, MindModel
from planners.person_following.structured.known_maps.scenes import FAR
from planners.person_following.structured.known_maps.ways import CLOCK, GONE, HEADS_FOR, OWN, PLACE, SCENE, Ways
from planners.search.random_bits import stream
from tests.planners.person_following.mind_models import CODEC, MAPS, brute_force, experience_of, starts


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> tuple[Experience, MindModel]:
    """Goals that move."""
    experience = experience_of("false_belief", tmp_path_factory.mktemp("moving"))
    return experience, learn_minds(CODEC, experience, {"for": "tests"})


@pytest.fixture(scope="module")
def model(moving: tuple[Experience, MindModel]) -> MindModel:
    return moving[1]


@pytest.fixture(scope="module")
def ways(model: MindModel) -> Ways:
    return Ways(model, CODEC, 0.99)


def test_robots_that_rest_are_found_out(moving: tuple[Experience, MindModel]) -> None:
    experience = moving[0]
    following = experience.select(np.char.startswith(experience.source, "following"))
    _, moved = learn_frame(following)
    rests = (following.t - following.t.min()) % 5 == 4  # robot_rest of the variant
    assert not moved[rests & (following.action != STAY)].any()
    assert moved[~rests & (following.action < FORWARD)].all()
    chance = moving[1].moved_chance
    assert chance[4::5, 0].max() < 0.01 and chance[:4, 0, 0, 0].min() > 0.99
    assert chance[0, FORWARD, 1].max() < 0.05 and chance[0, FORWARD, 0, 1] < 0.05 and chance[0, FORWARD, 0, 0] > 0.99


def test_scenes_are_the_maps(model: MindModel) -> None:
    grids, _ = load_domain("person_following").maps("false_belief")
    scenes = model.scenes
    for s in range(MAPS):
        fitting = 0
        for grid in grids:
            true = np.full_like(scenes.kinds[s], UNSEEN)
            # the robot starts at (1, 1) and looks to the right, along the map's x; its right-hand side is the map's y
            for x in range(9):
                for y in range(9):
                    side, ahead = y - 1 - scenes.origin, x - 1 - scenes.origin
                    if 0 <= side < len(true) and 0 <= ahead < len(true):
                        true[side, ahead] = grid[x, y]
            known = (scenes.kinds[s] != UNSEEN) & (true != UNSEEN) & (scenes.kinds[s] != GOAL) & (true != GOAL)
            fitting += bool((scenes.kinds[s] == true)[known].all())
        assert fitting == 1
    found = (scenes.goals >= 0).sum(1)
    assert found.max() == 2 and found.mean() > 1.5  # two each; some of them are far from where anybody came


def test_walks_are_shortest(model: MindModel) -> None:
    scenes = model.scenes
    rng = np.random.default_rng(0)
    for _ in range(200):
        s = int(rng.integers(MAPS))
        stations, cells = np.flatnonzero(scenes.cell[s] >= 0), np.unique(scenes.cell[s][scenes.cell[s] >= 0])
        q, c = int(rng.choice(stations)), int(rng.choice(cells))
        length = int(scenes.walk[s, q, c])
        after = scenes.walk[s, scenes.follows[s, q], c].astype(int)
        assert (length == 0) == (scenes.cell[s, q] == c)
        if 0 < length < FAR:
            assert after.min() == length - 1


def test_stations_show_what_robots_saw(moving: tuple[Experience, MindModel]) -> None:
    experience, model = moving
    first = experience.select((experience.t == experience.t.min()) & (experience.source == "following-mixture"))
    scene = np.searchsorted(model.scenes.keys, first.map_id)
    begin = model.scenes.station(scene, np.tile([0, 0, 3], (len(first), 1)))
    assert (model.scenes.view[scene, begin] == first.view).all()


def test_the_goal_is_found_to_move_once_and_unseen(model: MindModel) -> None:
    chances = np.array([[model.vanish_chance(t, seen) for seen in (False, True)] for t in range(20)])
    assert chances[2, 0] > 0.9  # goal_moves_at 3: in the third step
    assert np.delete(chances[:, 0], 2).max() < 0.1 and chances[:, 1].max() < 0.1


def test_intentions_are_found_without_being_logged(moving: tuple[Experience, MindModel]) -> None:
    model = moving[1]
    rows = model.intentions.counts.sum(-1) > 5
    sure = model.intentions.counts.max(-1)[rows] / model.intentions.counts.sum(-1)[rows]
    assert sure.mean() > 0.95  # persons' plans are deterministic given the goal
    assert model.policy[rows].sum(-1) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_filter_is_brute_force_bayes(model: MindModel, ways: Ways, seed: int) -> None:
    rng = np.random.default_rng(seed)
    node, q = starts(model)[int(rng.integers(2 * MAPS))], 0
    actions: list[int] = []
    seen: list[tuple[np.ndarray, np.ndarray | None]] = []
    scenes = model.scenes
    for k in range(5):
        s, p = node[SCENE], node[PLACE]
        visible = scenes.sees[s, q, scenes.cell[s, p]] and scenes.cell[s, q] != scenes.cell[s, p]
        hidden = 0 if node[GONE] < 0 else 1 << node[GONE]
        pose = scenes.relative(*map(np.array, ([s], [q], [p])))[0] if visible else None
        seen.append((ways.codes[ways.packed.shows[s, q, hidden]], pose))
        if k == 4:
            break
        action = int(rng.choice([0, 1, 2, 2, 3]))
        after = ways.successors(node)
        node = max(after, key=lambda one: after[one])
        q = int(scenes.follows[s, q, action])
        actions.append(action)
    belief = MindBelief(ways, "perspective-shift", rng)
    belief.reset(*seen[0])
    for action, (code, pose) in zip(actions, seen[1:], strict=True):
        belief.update(action, code, pose)
    assert belief.resets == 0
    exact = brute_force(ways, model, actions, seen)
    found: Counter[tuple[int, int, int]] = Counter()
    for (one, _, _), weight in belief.weights.items():
        found[one[SCENE], one[HEADS_FOR], one[OWN]] += weight  # type: ignore[assignment]
    for key, weight in exact.items():
        assert found[key] == pytest.approx(weight, abs=1e-4)


def test_the_influence_is_the_mixture_of_the_policy(model: MindModel, ways: Ways) -> None:
    belief = MindBelief(ways, "perspective-shift", np.random.default_rng(0))
    node = starts(model)[0]
    other = (*node[:HEADS_FOR], 1 - node[HEADS_FOR], *node[OWN:])
    belief.weights = {(node, 0, 0): 0.3, (other, 0, 0): 0.7}  # type: ignore[dict-item]
    policy = model.policy[node[SCENE], :, node[PLACE]]
    assert belief.influence() == pytest.approx(0.3 * policy[node[HEADS_FOR]] + 0.7 * policy[other[HEADS_FOR]])


def test_rules_take_moves_out_of_the_policy(model: MindModel) -> None:
    ways = Ways(model, CODEC, 0.99)
    s, _, p, z, *_ = starts(model)[0]
    before = ways.policy[s, z, p].copy()
    possible = np.ones((len(ways.codes), 3), np.bool_)
    seen = int(ways.packed.shows[s, p, 0])
    possible[seen, int(before[:3].argmax())] = False
    ways.constrain(possible)
    after = ways.policy[s, z, p]
    assert after[before[:3].argmax()] == 0.0 and after.sum() == pytest.approx(1.0)
    others = model.scenes.cell[s] >= 0
    others[ways.packed.shows[s, :, 0] == seen] = False
    assert ways.policy[s, z, others] == pytest.approx(model.policy[s, z, others])


def test_persons_learn_of_a_moved_goal_by_seeing_or_as_the_mode_has_it(model: MindModel, ways: Ways) -> None:
    knowing = Ways(model, CODEC, 0.99, slack=0.01)
    mistaken = 0
    for start in starts(model):
        node = start
        for _ in range(8):
            after = ways.successors(node)
            node = max(after, key=lambda one: after[one])
            if node[GONE] >= 0:
                assert (node[HEADS_FOR] != node[OWN]) <= (not ways.seen(node[SCENE], node[PLACE], node[GONE]))
                mistaken += node[HEADS_FOR] != node[OWN]
        node = start
        for _ in range(8):
            after = knowing.successors(node)
            node = max(after, key=lambda one: after[one])
            assert node[HEADS_FOR] == node[OWN]
    assert mistaken > 0


def test_modes_put_other_things_in_the_persons_mind(model: MindModel, ways: Ways) -> None:
    scenes = model.scenes
    s, _, p, z, *_ = starts(model)[0]
    code = ways.codes[ways.packed.shows[s, 0, 0]]
    pose = scenes.relative(*map(np.array, ([s], [0], [p])))[0]
    place = scenes.place[s, scenes.goals[s, z]]  # at the start the frame is the robot's own
    found: dict[str, np.ndarray] = {}
    for mode in ("zero", "random", "perfect-information"):
        belief = MindBelief(ways, mode, np.random.default_rng(1))
        belief.reset(code, pose, ((int(place[0]), int(place[1])), (int(place[0]), int(place[1]))))
        weights = np.zeros((MAPS, 2))
        for (node, _, _), weight in belief.weights.items():
            weights[node[SCENE], node[HEADS_FOR]] += weight
        found[mode] = weights[s] / weights[s].sum()
    assert found["zero"] == pytest.approx([0.5, 0.5])
    assert sorted(found["random"]) == pytest.approx([0.0, 1.0])
    assert found["perfect-information"][z] == pytest.approx(1.0)


def test_values_satisfy_bellmans_equation(model: MindModel) -> None:
    ways = Ways(model, CODEC, 0.9)
    ways.numbers(starts(model))
    packed, scenes = ways.packed, model.scenes
    rng = np.random.default_rng(2)
    checked = 0
    for number in rng.choice(len(ways), 60, replace=False):
        s, t, p = packed.node[number, [SCENE, CLOCK, PLACE]]
        if packed.successor[number, 0] < 0:
            continue
        q, lost = int(rng.choice(np.flatnonzero(scenes.cell[s] >= 0))), int(rng.integers(model.num_lost))
        values = []
        for action in range(4):
            faced = scenes.follows[s, q, FORWARD]
            ahead = int(faced != q and scenes.cell[s, faced] == scenes.cell[s, p])
            moved = model.moved_chance[t, action, int(action == FORWARD and faced == q), ahead] if action != STAY else 1
            total, below = 0.0, 0.0
            for after, reached in zip(packed.successor[number], packed.chance[number], strict=True):
                if after < 0:
                    break
                share, below = reached - below, reached
                _, _, there, _, own, _, standing = packed.node[after]
                for then, chance in ((scenes.follows[s, q, action], moved), (q, 1 - moved)):
                    if chance < 0.01:
                        continue
                    cell, person, home = scenes.cell[s, then], scenes.cell[s, there], scenes.goals[s, own]
                    length = min(int(scenes.walk[s, then, person]), MAX_WALK)
                    front = scenes.follows[s, then, FORWARD]
                    reward, goes_on = model.judgement[
                        length,
                        int(scenes.sees[s, then, person] and cell != person),
                        int(person == home),
                        standing,
                        lost,
                        int(cell == home and then != q and action == FORWARD),
                        int(action == FORWARD and front != then and scenes.cell[s, front] == person),
                        int(cell == person),
                    ]
                    later = packed.value[after, then, model.lost_chance[length, lost].argmax()]
                    total += share * chance * (reward + 0.9 * goes_on * later)
            values.append(total)
        assert packed.value[number, q, lost] == pytest.approx(max(values), abs=1e-3)
        checked += 1
    assert checked > 20


def test_simulated_steps_follow_the_model(model: MindModel, ways: Ways) -> None:
    number = int(ways.numbers(starts(model)[:1])[0])
    tree, bits = MindTree(ways.packed), stream(np.random.default_rng(0))
    state, after, scratch = np.array([number, 0, 0]), np.zeros(3, np.int64), np.zeros(1, np.int64)
    counts: Counter[int] = Counter()
    for _ in range(4000):
        mind_advance(tree, state, 0, after, scratch, bits)
        counts[int(after[0])] += 1
    chances = np.diff(np.concatenate([[0.0], ways.packed.chance[number]]))
    for successor, chance in zip(ways.packed.successor[number], chances, strict=True):
        if successor >= 0:
            assert counts[int(successor)] / 4000 == pytest.approx(chance, abs=0.04)


def test_the_search_is_worth_its_leaves_where_all_is_known(model: MindModel, ways: Ways) -> None:
    belief = MindBelief(ways, "perspective-shift", np.random.default_rng(0))
    node = starts(model)[0]
    belief.weights = {(node, 0, 0): 1.0}
    search = MindSearch(ways, SearchConfig(simulations=400, mind_depth=6), np.random.default_rng(0))
    action, info = search.plan(belief.states)
    value = float(ways.packed.value[ways.numbers([node])[0], 0, 0])
    assert info["values"][action] <= value + 0.05 * abs(value) + 0.1
    assert info["values"][action] > value - 0.3 * abs(value) - 0.5
    masked, _ = search.plan(belief.states, np.arange(4) == (action + 1) % 4)
    assert masked == (action + 1) % 4
    again = MindSearch(ways, SearchConfig(simulations=400, mind_depth=6), np.random.default_rng(0)).plan(belief.states)
    assert again[1]["values"] == info["values"]
    seen = int(search.tree.key[search.tree.owner >= 0][0])
    assert search.describe(seen).startswith("code ")


def test_what_nothing_explains_is_passed_over(model: MindModel, ways: Ways) -> None:
    belief = MindBelief(ways, "perspective-shift", np.random.default_rng(0))
    s, _, p, *_ = starts(model)[0]
    pose = model.scenes.relative(*map(np.array, ([s], [0], [p])))[0]
    code = ways.codes[ways.packed.shows[s, 0, 0]]
    belief.reset(code, pose)
    assert belief.resets == 0
    assert belief.update(STAY, code, np.array([2, 0, 1])) == -np.inf  # the person cannot have come there
    assert belief.resets == 1 and sum(belief.weights.values()) == pytest.approx(1.0)


def test_stored_models_are_the_same_and_damage_is_named(model: MindModel, tmp_path: Path) -> None:
    model.save(tmp_path)
    again = MindModel.load(tmp_path)
    assert np.array_equal(again.policy, model.policy) and np.array_equal(again.judgement, model.judgement)
    assert np.array_equal(again.scenes.walk, model.scenes.walk) and again.provenance == {"for": "tests"}
    path = tmp_path / "minds.npz"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"minds\.npz"):
        MindModel.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scenes.follows", 9999),
        ("scenes.goals", 999),
        ("scenes.cell", -5),
        ("scenes.number", 9999),
        ("starts", 10_000),
        ("counts", -1),
        ("outcome.yes", 10**6),
        ("reward.slot", 77),
    ],
)
def test_what_points_elsewhere_is_refused(name: str, value: int, model: MindModel, tmp_path: Path) -> None:
    model.save(tmp_path)
    with np.load(tmp_path / "minds.npz") as stored:
        arrays = {key: stored[key].copy() for key in stored.files}
    arrays[name].flat[0] = value
    np.savez(tmp_path / "minds.npz", **arrays)
    with pytest.raises(UserError):
        MindModel.load(tmp_path)


def test_several_goals_are_noticed(moving: tuple[Experience, MindModel]) -> None:
    experience = moving[0]
    assert several_goals(experience)
    alone = (experience.view == GOAL).reshape(len(experience), -1).sum(1) < 2
    following = np.char.startswith(experience.source, "following")
    assert several_goals(experience.select(alone & following))  # one at a time, but it goes elsewhere
    assert not several_goals(experience.select(alone & ~following))
    assert (experience.view == WALL).any()


def test_a_goal_that_the_person_steps_on_has_not_moved(moving: tuple[Experience, MindModel]) -> None:
    view, then = np.zeros((1, 5, 5), np.uint8), np.zeros((1, 5, 5), np.uint8)
    view[0, 3, 1] = GOAL
    step = replace(moving[0].select(np.array([0])), view=view, next_view=then)
    for configuration, several in ((0, True), (1 + (3 * 5 + 1) * 4 + 2, False), (1 + (3 * 5 + 2) * 4, True)):
        there = np.array([configuration], np.int16)
        for action in (STAY, FORWARD):  # who moves sees other cells
            found = several_goals(replace(step, action=np.array([action], np.int8), next_configuration=there))
            assert found == (several and action == STAY)
