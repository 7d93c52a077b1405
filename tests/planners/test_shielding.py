"""Masks over actions from rule files: from codes alone, remembered, and the same in another process."""

import pickle

import numpy as np
import pytest

from domains.core import load_domain
from nesy.errors import UserError
from planners.shielding import ShieldMask

RULES = """
forbidden(forward) :- now(wall_ahead).
forbidden(forward) :- now(person_ahead).
"""
AHEAD = 1 + (2 * 5 + 3) * 4


class CellCodec:
    """A code that says what is ahead (factor 0) and where the goal is (factor 1)."""

    num_factors, num_values = 2, 4

    def views(self, codes):
        views = np.zeros((len(codes), 5, 5), np.uint8)
        views[:, 2, 3] = codes[:, 0]
        views[:, 0, 0] = np.where(codes[:, 1] == 1, 2, 0)
        return views


def mask(rules=RULES, **options):
    return ShieldMask([rules], CellCodec(), load_domain("person_following"), **options)


CODES = np.array([[0, 0], [1, 0], [2, 1], [0, 1]], np.uint8)


def test_predicates_are_those_of_the_decoded_view_and_the_person_comes_from_the_configuration():
    found = mask()(CODES, np.array([0, 0, 0, AHEAD]))
    np.testing.assert_array_equal(found[:, 2], [True, False, True, False])
    assert found[:, [0, 1, 3]].all()
    assert mask().advise(CODES[1], 0).because == {"forward": ("program:2:1",)}


def test_answers_are_remembered_and_the_same_in_any_batch():
    shield = mask()
    rng = np.random.default_rng(0)
    codes = np.stack([rng.integers(0, 3, 200), rng.integers(0, 2, 200)], axis=1).astype(np.uint8)
    places = rng.integers(0, 101, 200)
    together = shield(codes, places)
    asked = []
    shield.shield.advise = lambda *situation: asked.append(situation)
    for b in range(200):
        np.testing.assert_array_equal(shield(codes[b : b + 1], places[b : b + 1])[0], together[b])
    assert not asked
    assert mask()(codes[:0], places[:0]).shape == (0, 4)


def test_the_person_can_be_named_by_its_place():
    shield = mask(
        "forbidden(right) :- person_at(1,0,_). forbidden(left) :- person_at(-2,3,1). forbidden(stay) :- unseen."
    )
    encode = load_domain("person_following").spec.geometry.encode
    places = np.array([0, int(encode(3, 4, 2)), int(encode(0, 1, 1)), int(encode(0, 1, 0))])
    assert shield(np.zeros((4, 2), np.uint8), places).tolist() == [
        [True, True, True, False],
        [True, False, True, True],
        [False, True, True, True],
        [True, True, True, True],
    ]


def test_preferred_actions_are_chosen_among_the_allowed_ones():
    shield = mask(
        "preferred(forward) :- now(goal_visible). forbidden(forward) :- now(wall_ahead). preferred(left) :- unseen."
    )
    found = shield(np.array([[0, 1], [1, 1], [0, 0]], np.uint8), np.array([AHEAD, AHEAD, 0]))
    assert found.tolist() == [[False, False, True, False], [True, True, False, True], [True, False, False, False]]


def test_conflicts_name_their_rules_once_and_fall_back(caplog):
    rules = "forbidden(A) :- action(A), now(wall_ahead)."
    shield = mask(rules)
    found = shield(np.array([[1, 0], [1, 1], [1, 0]], np.uint8), np.zeros(3, int))
    assert (found == [False, False, False, True]).all()
    assert shield.conflicts == {("program:1:1",): 2}
    assert [record.getMessage() for record in caplog.records] == [
        "the shield leaves no action; these rules conflict: program:1:1"
    ]
    assert mask(rules, fallback="all")(CODES[1:2], np.zeros(1, int)).all()
    with pytest.raises(UserError, match="program:1:1"):
        mask(rules, fallback="error")(CODES[1:2], np.zeros(1, int))


def test_masks_travel_to_other_processes(tmp_path):
    path = tmp_path / "rules.lp"
    path.write_text(RULES)
    shield = ShieldMask([path], CellCodec(), load_domain("person_following"))
    first = shield(CODES, np.zeros(4, int))
    path.unlink()
    other = pickle.loads(pickle.dumps(shield))
    np.testing.assert_array_equal(other(CODES, np.zeros(4, int)), first)
    assert other.advise(CODES[1], 0).because == {"forward": (f"{path}:2:1",)}


def test_wrong_shapes_are_explained():
    with pytest.raises(UserError, match=r"codes \[B, 2\]"):
        mask()(np.zeros((2, 3), np.uint8), np.zeros(2, int))
