"""Φ: imagined walks, memory, fallbacks, and the influence modes."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from domains.core import ViewGeometry
from nesy.errors import UserError
from nesy.perspective.influence import INFLUENCE_MODES
from nesy.perspective.operator import (
    InfluenceBelief,
    PerspectiveShift,
    TableModel,
    imagine,
    shift,
)
from nesy.perspective.shortest_paths import plan, poses_along, recalled
from nesy.world_model import SymbolicCodec, SymbolicWorldModel

GEOMETRY = ViewGeometry()
STEPS = {0: (1, 0), 1: (0, 1), 2: (-1, 0), 3: (0, -1)}


def shortest(view: np.ndarray, target: tuple[int, int, int]) -> int:
    """Number of actions of a shortest way, by an independent breadth-first search; -1 for none."""
    start = (2, 4, 3)
    distance = {start: 0}
    queue = deque([start])
    while queue:
        x, y, h = pose = queue.popleft()
        if pose == target:
            return distance[pose]
        fx, fy = x + STEPS[h][0], y + STEPS[h][1]
        followers = [(x, y, (h + 1) % 4), (x, y, (h - 1) % 4)]
        if 0 <= fx < 5 and 0 <= fy < 5 and view[fx, fy] in (0, 2):
            followers.append((fx, fy, h))
        for then in followers:
            if then not in distance:
                distance[then] = distance[pose] + 1
                queue.append(then)
    return -1


views = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).choice([0, 0, 0, 1, 2, 3], (5, 5)).astype(np.uint8)
)


@settings(max_examples=60, deadline=None)
@given(views, st.integers(0, 4), st.integers(0, 4), st.integers(0, 3))
def test_paths_are_shortest_and_lead_there(view: np.ndarray, vx: int, vy: int, heading: int) -> None:
    trees, target = plan(view[None]), int(GEOMETRY.encode(vx, vy, heading)) - 1
    assert trees.depth[0, target] == shortest(view, (vx, vy, heading))
    if trees.depth[0, target] >= 0:
        way, actions = trees.way(0, target)
        poses = poses_along(way, 5)
        assert poses[0] == (2, 4, 3)
        assert poses[-1] == (vx, vy, heading)
        for (x, y, h), action, then in zip(poses, actions, poses[1:], strict=False):
            ahead = (x + STEPS[h][0], y + STEPS[h][1], h)
            assert then == ((x, y, (h - 1) % 4), (x, y, (h + 1) % 4), ahead)[action]
            assert view[then[:2]] in (0, 2) or action != 2


@settings(max_examples=30, deadline=None)
@given(views, st.integers(0, 3))
def test_memory_of_a_turn_and_of_a_step(view: np.ndarray, seed: int) -> None:
    view[2, 4] = 0
    poses = [int(GEOMETRY.encode(2, 3, heading)) - 1 for heading in (3, 2)]
    memory = recalled(np.repeat(view[None], 2, axis=0), np.array(poses))
    # One step ahead, the row that was v is now v + 1, and the far row is new.
    ahead = memory[0].copy()
    assert (ahead[:, 0] == 3).all()
    expected = view[:, :4].copy()
    expected[2, 3] = 0  # the viewer's own cell shows as empty
    np.testing.assert_array_equal(ahead[:, 1:], expected)
    left = memory[1]
    assert left[2, 3] == view[1, 3]  # what was to the left is now ahead
    assert left[3, 4] == view[2, 2]  # what was ahead is now to the right


class Untrained:
    """A codec over a random table whose views are open, so that every pose can be reached."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        model = SymbolicWorldModel(hidden=8, num_factors=3, num_values=3, num_actions=4)
        from nesy.world_model import Structure

        structure = Structure((((0,), (1,), (2, 0)),) * 4, (((), (0,), ()),) * 4, (0, 1, 2))
        edges = 40
        model.set_transitions(
            structure, rng.integers(0, 3, (edges, 3)), rng.integers(0, 4, edges),
            rng.integers(0, 3, (edges, 3)), rng.integers(1, 9, edges),
        )  # fmt: skip
        self.codec = SymbolicCodec(model)
        self.num_factors, self.num_values = 3, 3
        self.asked = 0

    def views(self, codes: np.ndarray) -> np.ndarray:
        self.asked += len(codes)
        return np.zeros((len(codes), 5, 5), dtype=np.uint8)

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.codec.predict(beliefs, actions)

    def packed(self):  # type: ignore[no-untyped-def]
        return self.codec.packed()

    def beliefs(self, views: np.ndarray) -> np.ndarray:
        return np.eye(3, dtype=np.float32)[np.repeat(views[:, 0, :1] % 3, 3, 1)]


def certain(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.eye(3, dtype=np.float32)[rng.integers(0, 3, (count, 3))]


@pytest.mark.parametrize("planner", ["table", "network"])
def test_an_empty_path_is_the_identity(planner: str) -> None:
    rng = np.random.default_rng(0)
    own_pose = int(GEOMETRY.encode(2, 4, 3))
    for beliefs in (certain(rng, 20), rng.dirichlet(np.ones(3), (20, 3)).astype(np.float32)):
        shifted = shift(beliefs, np.full(20, own_pose), Untrained(), planner=planner)
        np.testing.assert_array_equal(shifted.beliefs, beliefs)
        assert shifted.reachable.all()
        assert (shifted.num_actions == 0).all()


@pytest.mark.parametrize("planner", ["table", "network"])
def test_memory_equals_a_direct_computation(planner: str) -> None:
    rng = np.random.default_rng(1)
    beliefs, configurations = certain(rng, 300), rng.integers(0, 101, 300)
    model = Untrained()
    together = PerspectiveShift(model, planner)
    first = together(beliefs, configurations)
    asked = model.asked
    again = together(beliefs[::-1], configurations[::-1])
    assert model.asked == asked or planner == "table"
    np.testing.assert_array_equal(first.beliefs, again.beliefs[::-1])
    for row in range(0, 300, 17):
        alone = shift(beliefs[row : row + 1], configurations[row : row + 1], Untrained(), planner=planner)
        np.testing.assert_allclose(alone.beliefs[0], first.beliefs[row], atol=1e-6)
        assert alone.num_actions[0] == first.num_actions[row]
        path = imagine(beliefs[row], int(configurations[row]), Untrained(), planner=planner)
        assert path.reachable == first.reachable[row]
        np.testing.assert_allclose(path.beliefs[-1], first.beliefs[row], atol=1e-6)
        assert len(path.actions) == first.num_actions[row]
    np.testing.assert_allclose(first.beliefs.sum(-1), 1.0, atol=1e-5)


def test_one_step_of_the_network_planner_is_one_prediction() -> None:
    rng = np.random.default_rng(2)
    model, belief = Untrained(), rng.dirichlet(np.ones(3), 3).astype(np.float32)
    path = imagine(belief, int(GEOMETRY.encode(2, 3, 3)), model, planner="network")
    assert path.actions == (2,)
    np.testing.assert_array_equal(path.beliefs[1], model.predict(belief[None], np.array([2]))[0])


def test_uniform_where_unseen_or_out_of_reach(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    beliefs = codec.beliefs(toy.view[:4])
    behind_the_wall = int(GEOMETRY.encode(0, 0, 1))
    for configuration in (0, behind_the_wall):
        shifted = shift(beliefs, np.full(4, configuration), codec)
        np.testing.assert_array_equal(shifted.beliefs, np.full_like(beliefs, 1 / 8))
        assert not shifted.reachable.any()
        path = imagine(beliefs[0], configuration, codec)
        assert not path.reachable
        assert path.actions == ()


def test_walking_ahead_in_the_toy_world_sees_what_is_there(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    """After one step ahead all that was seen is remembered, so the shifted view agrees with the true one there."""
    rows = np.flatnonzero((toy.action == 2) & (toy.view[:, 2, 3] == 0) & (toy.view != toy.next_view).any((1, 2)))[:60]
    shifted = shift(codec.beliefs(toy.view[rows]), np.full(len(rows), int(GEOMETRY.encode(2, 3, 3))), codec)
    assert (shifted.num_actions == 1).all()
    decoded = codec.views(shifted.codes)
    np.testing.assert_array_equal(decoded[:, :, 1:], toy.next_view[rows][:, :, 1:])


def test_a_table_model_shifts_as_its_network_does(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    class Tables:
        structure = codec.model.structure()  # type: ignore[operator]
        parents_now, parents_next, order = structure.parents_now, structure.parents_next, structure.order
        num_values = 8

        def cpt(self, action: int, factor: int) -> np.ndarray:
            return codec.model.conditional(action, factor)  # type: ignore[operator, no-any-return]

    distinct = np.unique(toy.view, axis=0)
    tables = TableModel(Tables(), codec.codes(distinct), distinct)
    beliefs = codec.beliefs(toy.view[:40])
    target = np.full(40, int(GEOMETRY.encode(2, 2, 3)))
    a, b = shift(beliefs, target, codec), shift(beliefs, target, tables)
    np.testing.assert_array_equal(a.reachable, b.reachable)
    # They differ only in the views of codes that stand for none, which the code book does not hold.
    np.testing.assert_array_equal(a.num_actions, b.num_actions)
    assert (a.codes == b.codes).all(1).mean() > 0.75
    np.testing.assert_array_equal(tables.views(codec.codes(distinct)), distinct)
    predicted = tables.predict(beliefs, np.full(40, 2))
    np.testing.assert_allclose(predicted, codec.predict(beliefs, np.full(40, 2)), atol=0.02)


def test_influence_modes() -> None:
    rng = np.random.default_rng(3)
    model, beliefs = Untrained(), certain(rng, 50)
    configurations = rng.integers(0, 101, 50)
    configurations[::10] = 0
    true_views = rng.integers(0, 3, (50, 5, 5)).astype(np.uint8)
    for mode in INFLUENCE_MODES:
        influence = InfluenceBelief(mode, model, np.random.default_rng(4))
        got = influence(beliefs, configurations, true_views)
        assert got.shape == beliefs.shape
        assert got.dtype == np.float32
        np.testing.assert_allclose(got.sum(-1), 1.0, atol=1e-5)
        if mode == "zero":
            assert (got == np.float32(1 / 3)).all()
        unseen = configurations == 0
        assert unseen.any()
        assert (got[unseen] == np.float32(1 / 3)).all()
        if mode == "random":
            assert set(np.unique(got[~unseen])) == {0.0, 1.0}
            assert (got != influence(beliefs, configurations)).any()
            repeated = InfluenceBelief(mode, model, np.random.default_rng(4))(beliefs, configurations)
            np.testing.assert_array_equal(got, repeated)
        if mode == "egocentric":
            np.testing.assert_array_equal(got[~unseen], beliefs[~unseen])
        if mode == "perfect-information":
            np.testing.assert_array_equal(got[~unseen], model.beliefs(true_views)[~unseen])
        if mode == "perspective-shift":
            np.testing.assert_array_equal(got, shift(beliefs, configurations, model).beliefs)
    with pytest.raises(UserError, match="unknown influence mode"):
        InfluenceBelief("telepathy", model, rng)
    with pytest.raises(UserError, match="true views"):
        InfluenceBelief("perfect-information", model, rng)(beliefs, configurations)
    with pytest.raises(UserError, match="unknown planner"):
        PerspectiveShift(model, "map")


def test_arrays_from_outside_are_checked(codec: SymbolicCodec) -> None:
    """An action or value too large read whatever lay behind a table."""
    views = np.zeros((2, 5, 5), np.uint8)
    codes = codec.codes(views)
    beliefs = codec.certain(codes)
    here = np.zeros(2, np.int64)
    k = codec.num_values
    for wrong, message in (
        (lambda: codec.codes(views[0]), r"views have the shape \[any, 5, 5\], found \[5, 5\]"),
        (lambda: codec.codes(views + 4), "views are whole numbers in 0..3"),
        (lambda: codec.codes(views + 0.5), "views are whole numbers"),
        (lambda: codec.views(codes.astype(int) + k), f"codes are whole numbers in 0..{k - 1}"),
        (lambda: codec.certain(codes[:, 1:]), "codes have the shape"),
        (lambda: codec.predict(beliefs, here + 9), "actions are whole numbers"),
        (lambda: codec.predict(beliefs * 2, here), "beliefs are numbers >= 0 that sum to 1"),
        (lambda: shift(beliefs, here[:1], codec), r"configurations have the shape \[2\], found \[1\]"),
        (lambda: shift(beliefs, here + 101, codec), "configurations are whole numbers in 0..100"),
        (lambda: shift(beliefs, here - 1, codec), "configurations are whole numbers"),
        (lambda: shift(beliefs * np.nan, here, codec), "beliefs are numbers"),
    ):
        with pytest.raises(UserError, match=message):
            wrong()
