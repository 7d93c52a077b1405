"""Rules between factors and predicates: found again where they were put in, scored without leaks."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.asp import KnowledgeBase
from nesy.asp.semantics.induction import induce
from nesy.asp.semantics.minimal import minimal_form
from nesy.asp.semantics.predicates import determined, ordered, predicate_rules, value_rules
from nesy.asp.semantics.rules import applies, asp_value_rules
from nesy.asp.semantics.scores import folds, map_folds, maps_of, scores
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN

TREES = (
    ("wall_ahead", "goal_visible", "opening_visible"),
    ("cell_wall_1_3", "cell_wall_3_3", "goal_to_left"),
    ("cell_wall_0_1", "cell_wall_4_1", "cell_empty_2_1"),
)


@pytest.fixture(scope="module")
def readable():
    """All views of the crossing task with codes of three factors: eight values each, from three predicates."""
    from domains.core import load_domain

    domain = load_domain("person_following")
    views = domain.views("paper", "crossing")
    truth = domain.predicates.evaluate(views)
    names = list(domain.predicates.names)
    codes = np.stack([truth[:, [names.index(p) for p in tree]] @ [4, 2, 1] for tree in TREES], axis=1)
    return Codebook.build(views, codes.astype(np.uint8), np.ones(len(views)), domain.predicates)


def test_a_predicate_is_read_off_the_values_of_its_factor(readable):
    assert len(readable) == 732
    for factor, tree in enumerate(TREES):
        for position, name in enumerate(tree):
            rules = predicate_rules(readable, name, num_values=8)
            (rule,) = rules.rules
            bit = 4 >> position
            met = np.unique(readable.codes[:, factor])
            assert rule.conditions == ((factor, tuple(v for v in met if v & bit)),)
            assert (rules.precision, rules.recall, rules.accuracy) == (1, 1, 1)


def test_a_value_has_the_shortest_rule_over_named_predicates_first(readable):
    rules = value_rules(readable, 0, 5)
    names = ordered(readable.predicate_names)
    (rule,) = rules.rules
    assert {(names[c], values) for c, values in rule.conditions} == {
        ("wall_ahead", (1,)),
        ("goal_visible", (0,)),
        ("opening_visible", (1,)),
    }
    assert rules.precision == rules.recall == rules.accuracy == 1
    text = asp_value_rules(rules, "at(0,5)", "now", names)
    assert text == "at(0,5) :- now(wall_ahead), not now(goal_visible), now(opening_visible)."


def test_what_few_factors_settle_counts_as_determined(readable):
    settled = determined(readable, most_factors=1, least=20)
    assert {name for tree in TREES for name in tree} <= set(settled)
    assert "cell_wall_0_0" not in settled
    assert set(settled) <= set(determined(readable, most_factors=3, least=20))


def test_scores_of_readable_codes(readable):
    some = np.arange(0, len(readable), 2)
    book = Codebook.build(readable.views[some], readable.codes[some], readable.counts[some], None)
    book = replace(
        book,
        predicates=readable.predicates[some],
        predicate_names=readable.predicate_names,
        predicate_meanings=readable.predicate_meanings,
    )
    found = scores(book, 8, ("A", "B", "C"), [[v % 7] for v in range(len(book))])
    assert found["predicates"]["precision"] >= 0.99 and found["predicates"]["recall"] >= 0.99
    assert found["values"]["precision"] >= 0.95 and found["values"]["recall"] >= 0.95
    assert found["values"]["length"] <= 3
    assert found["predicates"]["maps_recall"] >= 0.99
    groups = found["by_factors"]
    assert groups["1"]["precision"] >= 0.99 and groups["1"]["recall"] >= 0.99
    assert sum(group["count"] for group in groups.values()) == found["all_predicates"]["count"]
    assert found["values"]["each"]["A=5"]["text"] == ["wall_ahead and not goal_visible and opening_visible"]


def test_held_out_views_are_not_learned_from(readable):
    # a predicate that is pure chance: what is held out cannot be guessed
    rng = np.random.default_rng(0)
    chance = rng.random(len(readable)) < 0.5
    number = np.arange(len(readable))
    book = Codebook(
        views=readable.views,
        codes=np.stack([number // 64, number // 8 % 8, number % 8], axis=1).astype(np.uint8),
        counts=readable.counts,
        predicates=chance[:, None],
        predicate_names=("coin",),
        predicate_meanings=("",),
    )
    rules = predicate_rules(book, "coin", held_out=0.5, num_values=12)
    assert 0.3 < rules.precision < 0.7
    assert predicate_rules(book, "coin", held_out=0.0, num_values=12).accuracy == 1


def test_folds_are_disjoint_and_those_of_maps_share_none():
    parts = folds(100, 0)
    assert sorted(np.concatenate(parts).tolist()) == list(range(100))
    found = map_folds([[0], [1], [0, 1], [2], [3], [2, 3]], 0)
    assert 2 not in np.concatenate(found) and 5 not in np.concatenate(found)
    assert sorted(np.concatenate(found).tolist()) == [0, 1, 3, 4]


def test_the_maps_of_views(readable):
    views = readable.views[[3, 5, 3]]
    met = maps_of(readable, views, np.array([7, 8, 9]))
    assert met[3] == [7, 9] and met[5] == [8] and met[0] == []


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_minimal_form_is_exact_and_as_short_as_brute_force_finds(seed):
    rng = np.random.default_rng(seed)
    columns = rng.random((40, 6)) < 0.5
    chosen = rng.choice(6, size=int(rng.integers(1, 4)), replace=False)
    signs = rng.random(len(chosen)) < 0.5
    truth = (columns[:, chosen] == signs).all(axis=1)
    if not truth.any() or truth.all():
        return
    form = minimal_form(columns, truth)
    assert form is not None and len(form) == 1
    here = np.all([columns[:, c] == holds for c, holds in form[0]], axis=0)
    np.testing.assert_array_equal(here, truth)
    shortest = next(
        size
        for size in range(1, 4)
        for picked in itertools.combinations(range(6), size)
        for values in itertools.product([False, True], repeat=size)
        if ((columns[:, picked] == values).all(axis=1) == truth).all()
    )
    assert len(form[0]) == shortest


def test_a_disjunction_is_found_where_no_conjunction_is_enough():
    columns = np.array(list(itertools.product([False, True], repeat=3)))
    truth = columns[:, 0] ^ columns[:, 1]
    form = minimal_form(columns, truth)
    assert form is not None and len(form) == 2
    assert {frozenset(one) for one in form} == {
        frozenset({(0, True), (1, False)}),
        frozenset({(0, False), (1, True)}),
    }
    # as many conjunctions as are allowed, and no more
    assert minimal_form(columns, columns.sum(axis=1) % 2 == 1, most_rules=3) is None


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_induced_rules_say_what_the_views_say(seed):
    rng = np.random.default_rng(seed)
    values = np.unique(rng.integers(0, 4, size=(60, 3)), axis=0)
    truth = rng.random(len(values)) < 0.3
    np.testing.assert_array_equal(applies(induce(values, truth, 4), values), truth)


def test_the_knowledge_base_shows_rule_and_picture(readable):
    table = np.tile(np.eye(8)[None], (3, 1, 1))
    base = KnowledgeBase(TwoSliceDBN.from_tables([list(table)], [[[0], [1], [2]]]), readable)
    text = base.means(0, 5).text
    assert "it holds exactly if wall_ahead and not goal_visible and opening_visible" in text
    picture = text.splitlines()[-6:-1]
    assert picture[3].split()[2] == "#" and picture[4].split()[2] == "."
    graph = base.means(0, 5).graph()
    assert graph.has_edge("wall_ahead and not goal_visible and opening_visible", "X0 = 5")
    finding = base.value_rules("X0", 5)
    assert finding.rows[0]["precision"] == 1 and "at(0,5) :-" in finding.rows[0]["asp"]
