"""Shields: masks, reasons, conflicts, and how fast they answer."""

import numpy as np
import pytest

from nesy.asp import KnowledgeBase
from nesy.asp.shield import Shield
from nesy.errors import UserError
from tests.nesy.dbn.toy import toy

ACTIONS = ("left", "right", "forward", "stay")
RULES = """
% never walk into a wall or the person
forbidden(forward) :- now(wall_ahead).
forbidden(forward) :- now(person_ahead).
preferred(stay) :- person(_,_,_), not now(person_ahead).
forbidden(left) :- at(3,5), unseen.
"""


def make(rules=RULES, **options):
    return Shield([rules], ACTIONS, 8, 8, ("wall_ahead", "goal_visible"), **options)


def configuration(x, y, heading):
    return 1 + (x * 5 + y) * 4 + heading


CODE = np.zeros(8, dtype=np.uint8)


def test_rules_become_a_mask_with_reasons():
    shield = make()
    assert shield.predicates == ("wall_ahead",)
    advice = shield.advise(CODE, np.array([True]), 0)
    assert advice.allowed == (True, True, False, True)
    assert advice.because == {"forward": ("program:3:1",)}
    assert shield.advise(CODE, np.array([False]), 0).allowed == (True,) * 4
    ahead = shield.advise(CODE, np.array([False]), configuration(2, 3, 1))
    assert ahead.allowed == (True, True, False, True) and ahead.because["forward"] == ("program:4:1",)
    assert ahead.preferred == (False,) * 4
    aside = shield.advise(CODE, np.array([False]), configuration(1, 3, 1))
    assert aside.allowed == (True,) * 4 and aside.preferred == (False, False, False, True)
    code = CODE.copy()
    code[3] = 5
    assert shield.advise(code, np.array([False]), 0).allowed == (False, True, True, True)
    both = shield.advise(code, np.array([True]), configuration(2, 3, 0))
    assert both.because == {"forward": ("program:3:1", "program:4:1")}


def test_masks_are_those_of_single_questions_in_any_order():
    shield, other = make(), make()
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 8, size=(50, 8)).astype(np.uint8)
    truth = rng.random((50, 1)) < 0.5
    places = rng.integers(0, 101, size=50)
    masks = shield.mask(codes, truth, places)
    for b in rng.permutation(50):
        assert tuple(masks[b]) == other.advise(codes[b], truth[b], int(places[b])).allowed
        wall, person = truth[b, 0], places[b] != 0 and (places[b] - 1) // 4 == 2 * 5 + 3
        assert masks[b, 2] == (not wall and not person)


def test_a_conflict_names_its_rules_and_falls_back():
    rules = "forbidden(A) :- action(A), now(wall_ahead).\nforbidden(stay) :- now(goal_visible)."
    truth = np.array([True, True])
    advice = make(rules).advise(CODE, truth, 0)
    assert advice.conflict and advice.allowed == (True,) * 4
    assert advice.because["stay"] == ("program:1:1", "program:2:1")
    assert make(rules, fallback="stay").advise(CODE, truth, 0).allowed == (False, False, False, True)
    with pytest.raises(UserError, match=r"program:1:1, program:2:1"):
        make(rules, fallback="error").advise(CODE, truth, 0)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ("forbidden(foward) :- now(wall_ahead).", r"forbidden\(foward\): no such action; the actions are left, right"),
        ("bad(fly). preferred(A) :- bad(A).", r"preferred\(fly\): no such action"),
        (
            "forbidden(forward) :- now(wal_ahead).",
            r"program:1:23-37: now\(wal_ahead\): no such predicate \(did",
        ),
        ("forbidden(forward) :- not nox(wall_ahead,2).", r"nothing makes nox\(wall_ahead,2\) true; #defined nox/2\."),
        ("forbiden(forward) :- now(wall_ahead).", "no rule has one of the heads forbidden, preferred"),
    ],
)
def test_a_misspelt_word_is_no_rule_that_never_applies(rules: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        make(rules)


def test_words_about_the_person_and_declared_ones_are_known() -> None:
    make(
        "person_forbidden(forward) :- person_now(wall_ahead), person_code(3,5). "
        "#defined tired/0. forbidden(left) :- tired."
    )


def test_rules_that_contradict_each_other_are_an_error():
    with pytest.raises(UserError, match="contradict"):
        make("forbidden(left) :- now(wall_ahead). :- forbidden(left).").advise(CODE, np.array([True]), 0)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ("forbidden(forward) :- now(wall_ahead)", "2:1"),
        ("#script (python) #end.", "script"),
        ("forbidden(A) :- not now(wall_ahead).", "unsafe"),
        ("n(0). n(X+1) :- n(X). forbidden(stay) :- n(-1).", "not grounded"),
    ],
)
def test_wrong_and_hostile_rules_are_refused_before_they_are_grounded_here(rules, message):
    with pytest.raises(UserError, match=message):
        make(rules, time_limit=1.0, memory_mb=512)


def test_wrong_settings_are_explained():
    with pytest.raises(UserError, match="fallback"):
        make(fallback="none")
    with pytest.raises(UserError, match="stay"):
        make(fallback="stay", stay="wait")
    with pytest.raises(UserError, match="truth"):
        make().mask(np.zeros((2, 8), dtype=np.uint8), np.zeros((2, 3), dtype=bool), np.zeros(2, dtype=int))


def test_the_knowledge_base_makes_shields():
    base = KnowledgeBase(*toy())
    shield = base.shield(["forbidden(go) :- now(wall_ahead)."], fallback="all")
    assert shield.mask(
        np.array([[1, 0, 0], [0, 0, 0]], dtype=np.uint8), np.array([[True], [False]]), np.zeros(2, int)
    ).tolist() == [
        [True, False],
        [True, True],
    ]


def test_no_forbidden_action_is_taken_in_the_real_environment():
    from domains.core import load_domain

    domain = load_domain("person_following")
    predicates = domain.predicates
    shield = Shield(
        ["forbidden(forward) :- now(wall_ahead). forbidden(forward) :- now(person_ahead)."],
        domain.spec.action_names,
        8,
        8,
        predicates.names,
        fallback="stay",
    )
    columns = [predicates.names.index(name) for name in shield.predicates]
    environment = domain.make("following", 64, seed=0)
    observation, _ = environment.reset(seed=0)
    rng = np.random.default_rng(0)
    forward = blocked = 0
    for _ in range(100):
        views, places = observation["view"], observation["configuration"]
        truth = predicates.evaluate(views)[:, columns]
        mask = shield.mask(np.zeros((64, 8), dtype=np.uint8), truth, places)
        actions = np.where(mask[:, 2], 2, rng.integers(0, 2, size=64))
        ahead = (views[:, 2, 3] == 1) | ((places > 0) & ((places - 1) // 4 == 2 * 5 + 3))
        assert not (ahead & (actions == 2)).any()
        forward += int((actions == 2).sum())
        blocked += int(ahead.sum())
        observation = environment.step(actions)[0]
    assert forward > 500 and blocked > 500


def test_rules_constrain_a_distribution_over_the_person_s_actions():
    shield = make("forbidden(forward) :- now(wall_ahead).")
    mask = shield.mask(np.zeros((3, 8), dtype=np.uint8), np.array([[True], [False], [True]]), np.zeros(3, dtype=int))
    prior = np.array([[0.1, 0.1, 0.8, 0.0], [0.1, 0.1, 0.8, 0.0], [0.0, 0.0, 1.0, 0.0]])
    constrained = shield.constrain(prior, mask)
    np.testing.assert_allclose(constrained, [[0.5, 0.5, 0.0, 0.0], prior[1], [1 / 3, 1 / 3, 0.0, 1 / 3]])
    with pytest.raises(UserError, match="expected"):
        shield.constrain(prior[:, :2], mask)
