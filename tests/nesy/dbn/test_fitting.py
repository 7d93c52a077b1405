"""Structure and rows recovered from transitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.dbn.codebook import Codebook
from nesy.dbn.evaluation.measures import fidelity
from nesy.dbn.evaluation.recovery import compare_arcs, random_model, random_transitions, recover
from nesy.dbn.inference.exact import likely_next
from nesy.dbn.inference.kernels import packed, sample_codes
from nesy.dbn.learning.extraction import extract
from nesy.dbn.learning.fitting import from_callable, from_experience
from nesy.dbn.learning.step_learning import with_observation, with_outcomes
from nesy.dbn.learning.structure import Search
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats import export, read
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.toy import Network, experience, toy


def test_structure_of_synthetic_models_is_recovered():
    found = recover(range(3))
    assert found.precision >= 0.98 and found.recall >= 0.98 and found.true == 48


def test_bic_misses_a_parent_that_matters_under_one_action_only():
    """Under `b` alone X1 tells whether X0 slips, in a few rows: BIC charges the whole table for it."""
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 8, size=(1600, 3)).astype(np.uint8)
    actions = (rng.random(1600) < 0.5).astype(np.int64)
    later = codes.copy()
    slips = (actions == 1) & (codes[:, 1] == 5) & (codes[:, 0] < 4)
    later[slips, 0] = 7
    bdeu = from_experience(codes, actions, later, num_values=8)
    bic = from_experience(codes, actions, later, num_values=8, search=Search(score="bic", max_next=1))
    assert bdeu.parents_now[0][0] == bic.parents_now[0][0] == (0,)
    assert set(bdeu.parents_now[1][0]) == {0, 1} and bic.parents_now[1][0] == (0,)
    rows = bdeu.rows(1, 0, np.array([[2, 5, 0], [2, 4, 0]]), np.zeros((2, 3), dtype=int))
    assert bdeu.cpt(1, 0)[rows[0], 7] > 0.5 > bdeu.cpt(1, 0)[rows[1], 7]


def test_rows_come_close_to_the_true_ones_and_rows_never_met_are_marked():
    rng = np.random.default_rng(0)
    dbn = random_model(rng, factors=3, values=3, parents=1)
    codes, actions, later = random_transitions(dbn, rng, 20_000)
    met = codes[:, 0] != 2
    learned = from_experience(codes[met], actions[met], later[met], num_values=3)
    for i in range(3):
        if learned.parents_now[0][i] == dbn.parents_now[0][i] == (0,):
            assert learned.counts(0, i)[2] == 0
            np.testing.assert_allclose(learned.cpt(0, i)[:2], dbn.cpt(0, i)[:2], atol=0.03)
    assert int(learned.counts(0, 0).sum()) == met.sum()


def test_arcs_within_the_next_slice_are_found():
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 4, size=(5000, 2)).astype(np.uint8)
    coin = rng.integers(0, 4, size=5000).astype(np.uint8)
    later = np.column_stack([coin, coin])
    learned = from_experience(codes, np.zeros(5000, dtype=int), later, num_values=4)
    assert learned.parents(0, 1) == ((1, 0),) and learned.parents(0, 0) == ()


def test_parents_of_a_network_given_as_a_callable():
    rng = np.random.default_rng(2)
    dbn = random_model(rng, factors=4, values=4, parents=2, actions=2)

    def predict(codes, action):
        return np.stack([dbn.cpt(action, i)[dbn.rows(action, i, codes.astype(int), codes)] for i in range(4)], axis=1)

    codes, actions, later = random_transitions(dbn, rng, 20_000)
    learned = from_callable(predict, codes, actions, later, num_values=4, action_names=("x", "y"))
    assert learned.parents_now == dbn.parents_now
    np.testing.assert_allclose(learned.probabilities, dbn.probabilities, atol=1e-4)
    figures = fidelity(learned, predict, _Transitions(codes, actions, later))
    assert figures["max_difference_to_network"] < 1e-4


class _Transitions:
    def __init__(self, codes, actions, later):
        self.codes, self.actions, self.next_codes = codes, actions, later
        self.view_codes = np.unique(codes, axis=0)
        self.views = np.zeros((len(self.view_codes), 1, 1), dtype=np.uint8)

    def distinct(self):
        kinds = np.column_stack([self.codes, self.actions, self.next_codes]).astype(np.uint8)
        kinds, counts = np.unique(kinds, axis=0, return_counts=True)
        n = self.codes.shape[1]
        return kinds[:, :n], kinds[:, n].astype(np.int64), kinds[:, n + 1 :], counts


@pytest.mark.parametrize("score", ["bic", "aic"])
def test_other_scores_work_and_unknown_ones_are_refused(score):
    rng = np.random.default_rng(3)
    dbn = random_model(rng, factors=3, values=3, parents=1)
    taken = random_transitions(dbn, rng, 5000)
    learned = from_experience(*taken, num_values=3, search=Search(score=score))
    assert compare_arcs(dbn, learned).recall == 1
    with pytest.raises(UserError, match="bdeu"):
        from_experience(*taken, num_values=3, search=Search(score="best"))


def test_nothing_to_count_from_is_an_error():
    nothing = np.zeros((0, 3), dtype=np.uint8)
    with pytest.raises(UserError, match="at least one transition"):
        from_experience(nothing, nothing[:, 0], nothing, num_values=3)


def test_extraction_by_enumeration_is_exact_and_counts_what_was_met():
    dbn, _ = toy()
    for action in range(2):
        for factor in range(3):
            np.testing.assert_array_equal(dbn.cpt(action, factor), Network().conditional(action, factor))
    # (side, front) = (1, 0): views 2 and 6
    assert dbn.counts(1, 1)[3] == 2
    assert dbn.counts(1, 1)[8] == 0
    figures = fidelity(dbn, Network(), experience())
    assert figures["max_difference_to_network"] == 0
    assert figures["nll"] == 0 and figures["nll_limit"] == 0 and figures["impossible"] == 0
    assert figures["rows"] == 9 + 9 + 9 or figures["rows"] == len(dbn.probabilities)


def test_the_limit_is_the_conditional_entropy():
    rng = np.random.default_rng(4)
    dbn = random_dbn(rng, num_actions=1)
    codes = np.zeros((4, 3), dtype=np.uint8)
    later = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=np.uint8)
    figures = fidelity(dbn, None, _Transitions(codes, np.zeros(4, dtype=int), later))
    assert figures["nll_limit"] == pytest.approx(1.5 * np.log(2))
    assert figures["nll"] >= figures["nll_limit"]
    assert figures["nll"] == pytest.approx(-dbn.log_prob(codes, 0, later).mean())


def test_extract_needs_initial_codes_that_exist():
    with pytest.raises(UserError):
        extract(
            Network(),
            *(np.zeros((1, 3), dtype=np.uint8), np.zeros(1, dtype=int), np.zeros((1, 3), dtype=np.uint8)),
            initial_codes=np.zeros((0, 3), dtype=np.uint8),
        )


@pytest.mark.parametrize("width", [0, 1, 3, 8, 9, 25])
def test_distinct_rows_are_numpy_s(width):
    from nesy.dbn.rows import unique_rows

    rows = 9000 if width == 8 else 300  # many rows take another way than few
    table = np.random.default_rng(width).integers(0, 2 + 254 * (width < 3), size=(rows, width)).astype(np.uint8)
    first, index, counts = unique_rows(table)
    if width:
        distinct, wanted_index, wanted_counts = np.unique(table, axis=0, return_inverse=True, return_counts=True)
        np.testing.assert_array_equal(table[first], distinct)
        np.testing.assert_array_equal(index, wanted_index.reshape(-1))
        np.testing.assert_array_equal(counts, wanted_counts)
    else:
        assert counts.tolist() == [rows]


def test_distinct_transitions_stand_for_all():
    from nesy.dbn.learning.transitions import with_counts

    taken = experience()
    codes, actions, later, counts = taken.distinct()
    assert counts.sum() == len(taken.codes) and len(counts) == 16
    dbn = toy()[0]
    whole = with_counts(dbn, taken.codes, taken.actions, taken.next_codes)
    short = with_counts(dbn, codes, actions, later, counts)
    np.testing.assert_array_equal(whole.row_counts, short.row_counts)
    for name in ("codes", "taken", "changed"):
        np.testing.assert_array_equal(whole.tables[name], short.tables[name])


CODES = np.array([[0, 1], [1, 0], [1, 1]] * 10)
ACTIONS = np.array([0, 1, 0] * 10)
LATER = CODES[::-1].copy()
WRONG = {
    "a negative code": ((np.where(CODES == 0, -1, CODES), ACTIONS, LATER), {}, "codes are .* in 0..1, found -1"),
    "a negative next code": ((CODES, ACTIONS, np.where(LATER == 0, -1, LATER)), {}, "next codes .* in 0..1, found -1"),
    "a next code too large": ((CODES, ACTIONS, 5 * LATER), {}, "next codes .* found 5"),
    "a code too large": ((2 * CODES, ACTIONS, LATER), {}, "codes .* found 2"),
    "an action beyond the last": ((CODES, 7 * ACTIONS, LATER), {"num_actions": 2}, "actions .* 0..1, found 7"),
    "a negative action": ((CODES, ACTIONS - 1, LATER), {}, "actions .* found -1"),
    "an action without a name": ((CODES, 2 * ACTIONS, LATER), {"action_names": ("x", "y")}, "actions .* 0..1, found 2"),
    "names without a list of them": ((CODES, np.array(["go", "stay", "go"] * 10), LATER), {}, "action_names must"),
    "an unknown name": ((CODES, ["go"] * 30, LATER), {"action_names": ("x", "y")}, "'go' is no action; .* x, y"),
    "two numbers of actions": ((CODES, ACTIONS, LATER), {"action_names": ("x", "y"), "num_actions": 3}, "is 3"),
    "no actions": ((CODES, ACTIONS, LATER), {"num_actions": 0}, "num_actions is a whole number from 1"),
    "half codes": ((0.5 * CODES, ACTIONS, LATER), {}, "found 0.5"),
    "no number": ((np.where(CODES == 0, np.nan, CODES), ACTIONS, LATER), {}, "found nan"),
    "texts": ((CODES.astype(str), ACTIONS, LATER), {}, "codes are whole numbers"),
    "rows of two lengths": (([[0, 1], [1]], [0, 1], [[0, 1], [1, 0]]), {}, "different lengths"),
    "one dimension": ((CODES[:, 0], ACTIONS, LATER[:, 0]), {}, r"shape \[any, any\], found \[30\]"),
    "too few actions": ((CODES, ACTIONS[:20], LATER), {}, r"actions have the shape \[30\], found \[20\]"),
    "too few next codes": ((CODES, ACTIONS, LATER[:20]), {}, r"next codes have the shape \[30, 2\]"),
    "other factors": ((CODES, ACTIONS, LATER[:, :1]), {}, r"next codes have the shape \[30, 2\]"),
    "half weights": ((CODES, ACTIONS, LATER), {"weights": np.full(30, 0.5)}, "weights .* found 0.5"),
    "weights that are no numbers": ((CODES, ACTIONS, LATER), {"weights": [np.nan] * 30}, "weights .* found nan"),
    "negative weights": ((CODES, ACTIONS, LATER), {"weights": [-1] * 30}, "weights .* found -1"),
    "too few weights": ((CODES, ACTIONS, LATER), {"weights": [1] * 29}, "weights"),
    "no weight": ((CODES, ACTIONS, LATER), {"weights": [0] * 30}, "all weights are 0"),
    "too much weight": ((CODES, ACTIONS, LATER), {"weights": [1 << 60] * 30}, "more transitions than can be counted"),
    "no values": ((CODES, ACTIONS, LATER), {"num_values": 0}, "num_values is a whole number from 1"),
    "half a value": ((CODES, ACTIONS, LATER), {"num_values": 2.5}, "num_values is a whole number"),
    "names of other factors": ((CODES, ACTIONS, LATER), {"factor_names": ("x",)}, "2 factors need as many"),
    "other initial codes": ((CODES, ACTIONS, LATER), {"initial_codes": [[2, 0]]}, "initial codes .* found 2"),
    "initial codes of fewer factors": ((CODES, ACTIONS, LATER), {"initial_codes": [[0]]}, "initial codes have"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", sorted(WRONG))
@pytest.mark.parametrize("way", ["experience", "callable"])
def test_columns_that_cannot_be_counted_are_refused_in_one_line(mistake, way):
    columns, options, message = WRONG[mistake]
    options = {"num_values": 2, **options}
    with pytest.raises(UserError, match=message) as caught:
        if way == "experience":
            from_experience(*columns, **options)
        else:
            from_callable(lambda codes, action: np.full((len(codes), 2, 2), 0.5), *columns, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fit", [from_experience, from_callable])
def test_a_misspelt_keyword_is_refused(fit):
    with pytest.raises(TypeError, match="factor_name"):
        fit(CODES, ACTIONS, LATER, num_values=2, factor_name=("x", "y"))


def test_columns_in_other_forms_are_the_same_where_they_are_exact():
    expected = from_experience(CODES, ACTIONS, LATER, num_values=2, weights=np.arange(30))
    forms = (
        (CODES.tolist(), ACTIONS.tolist(), LATER.tolist(), np.arange(30).tolist()),
        (CODES.astype(bool), ACTIONS.astype(float), LATER.astype(np.float32), np.arange(30.0)),
        (CODES.astype(np.uint8), ACTIONS.astype(np.int8), LATER.astype(object), np.arange(30, dtype=np.uint64)),
        (CODES[1:], ACTIONS[1:], LATER[1:], np.arange(1, 30)),  # met 0 times is not met
    )
    for *columns, weights in forms:
        found = from_experience(*columns, num_values=2, weights=weights)
        assert found.parents_now == expected.parents_now
        np.testing.assert_array_equal(found.probabilities, expected.probabilities)
        np.testing.assert_array_equal(found.row_counts, expected.row_counts)
        for name in ("codes", "taken", "changed"):
            np.testing.assert_array_equal(found.tables[name], expected.tables[name])
    names = np.array(["x", "y"])[ACTIONS]
    named = from_experience(CODES, names, LATER, num_values=2, action_names=("x", "y"), weights=np.arange(30))
    np.testing.assert_array_equal(named.probabilities, expected.probabilities)


@given(st.integers(1, 3), st.integers(1, 5), st.integers(1, 4), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_rows_are_the_counted_shares(factors, values, actions, seed):
    """Against plain counting in dictionaries: whatever parents are chosen, rows and counts are those of the steps."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 60))
    codes, later = rng.integers(0, values, (2, n, factors))
    taken, often = rng.integers(0, actions, n), rng.integers(0, 4, n)
    often[0] = 1
    dbn = from_experience(codes, taken, later, num_values=values, num_actions=actions, weights=often, prior_count=1e-9)
    assert dbn.tables["taken"].tolist() == [int(often[taken == a].sum()) for a in range(actions)]
    for a in range(actions):
        for i in range(factors):
            counted: dict[int, np.ndarray] = {}
            for row in np.flatnonzero((taken == a) & (often > 0)):
                key = 0
                for where, parent in dbn.parents(a, i):
                    key = key * values + int((codes, later)[where][row, parent])
                counted.setdefault(key, np.zeros(values))[later[row, i]] += often[row]
            for key in range(dbn.num_rows(a, i)):
                mass = counted.get(key, np.zeros(values))
                assert dbn.counts(a, i)[key] == mass.sum()
                if mass.sum():
                    np.testing.assert_allclose(dbn.cpt(a, i)[key], mass / mass.sum(), atol=1e-6)


def test_an_action_never_taken_has_rows_never_met():
    dbn = from_experience(CODES, 2 * ACTIONS, LATER, num_values=2, num_actions=4)
    assert dbn.tables["taken"].tolist() == [20, 0, 10, 0]
    for a in (1, 3):
        for i in range(2):
            assert dbn.parents(a, i) == () and dbn.counts(a, i).tolist() == [0]
            np.testing.assert_allclose(dbn.cpt(a, i)[0], np.bincount(LATER[:, i]) / 30)


@pytest.mark.parametrize("values", [256, 257, 300, 70_000 // 64])
def test_factors_may_have_many_values(values, tmp_path):
    codes = np.repeat(np.arange(values), 20)[:, None]
    dbn = from_experience(codes, np.zeros(len(codes), int), (codes + 1) % values, num_values=values, prior_count=1e-6)
    assert dbn.parents(0, 0) == ((0, 0),)
    np.testing.assert_array_equal(dbn.cpt(0, 0).argmax(1), (np.arange(values) + 1) % values)
    np.testing.assert_array_equal(dbn.tables["codes"], np.arange(values)[:, None])
    every = np.arange(values)[:, None]
    np.testing.assert_array_equal(dbn.sample(every, 0, np.random.default_rng(0)), (every + 1) % values)
    np.testing.assert_array_equal(likely_next(dbn, every, 0)[0][:, 0], (every + 1) % values)
    drawn = sample_codes(packed(dbn), every, np.zeros(values, int), np.full((values, 1), 0.5))
    np.testing.assert_array_equal(drawn, (every + 1) % values)
    for name in ("native", "parquet", "jgum"):
        export(dbn, tmp_path / name, name)
        again = read(tmp_path / name, name)
        np.testing.assert_array_equal(again.probabilities, dbn.probabilities)
        np.testing.assert_array_equal(again.tables["codes"], dbn.tables["codes"])


def test_tables_are_as_large_as_their_limit_allows():
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 60, (4000, 3))
    later = np.column_stack([codes.sum(1) % 60, codes[:, 1], codes[:, 2]])
    dbn = from_experience(codes, np.zeros(4000, int), later, num_values=60, search=Search(max_rows=3600))
    assert max(len(dbn.parents(0, i)) for i in range(3)) <= 2


def test_transitions_of_another_model_are_not_counted():
    from nesy.dbn.learning.transitions import with_counts

    dbn = from_experience(CODES, ACTIONS, LATER, num_values=2)
    for columns, message in (
        ((CODES[:, :1], ACTIONS, LATER[:, :1]), "has 2 factors, not 1"),
        ((2 * CODES, ACTIONS, LATER), "codes are whole numbers in 0..1"),
        ((CODES, ACTIONS + 1, LATER), "actions are whole numbers in 0..1, found 2"),
    ):
        with pytest.raises(UserError, match=message):
            with_counts(dbn, *columns)


@pytest.mark.parametrize(
    ("tables", "parents", "message"),
    [
        ([[np.full((3, 3), 1 / 3), np.full((2, 2), 0.5)]], [[(0,), (1,)]], "factor 1 under action 0 is of 2 values"),
        ([[np.full((2, 2), 0.5), np.full((1, 4), 0.25)]], [[(0,), (1,)]], "factor 1 under action 0 is of 4 values"),
        ([[np.full((4, 2), 0.5), np.full((2, 2), 0.5)]], [[(0,), (0, 1)]], "must have 2 rows for its parents, found 4"),
        ([[np.full((2, 2), 0.5)] * 2, [np.full((2, 2), 0.5)]], [[(0,), (1,)], [(0,)]], "action 1 has 1 tables"),
        ([[np.full(2, 0.5)]], [[()]], r"shape \[rows, K\], found \[2\]"),
        ([[[[0.5, 0.5], [1.0]]]], [[(0,)]], "must be numbers"),
        ([[np.full((2, 2), 0.5)]], [[(0,), (1,)]], "one entry per action and factor"),
    ],
)
def test_tables_that_do_not_fit_are_not_reshaped(tables, parents, message):
    with pytest.raises(UserError, match=message):
        TwoSliceDBN.from_tables(tables, parents)


# ------------------------------------------------------------------ reward and end
def _ends(done: np.ndarray, codes: np.ndarray, later: np.ndarray, values: int) -> tuple[TwoSliceDBN, float]:
    """A model with outcomes, and the largest error of P(ends) on its steps."""
    actions = np.zeros(len(codes), int)
    dbn = with_outcomes(
        from_experience(codes, actions, later, num_values=values),
        (codes, actions, later), np.arange(len(codes)), 2.0 * done - 1.0, done,
    )  # fmt: skip
    found = dbn.step_tables["termination"].look_up(codes, actions, later)[:, 0, 1]
    rewards = dbn.step_tables["reward"].look_up(codes, actions, later)[:, 0, 0]
    return dbn, max(float(np.abs(found - done).max()), float(np.abs(rewards - (2.0 * done - 1.0)).max()) / 2)


@pytest.mark.parametrize("rule", ["cells", "parity", "three", "both slices", "lines", "never"])
def test_an_end_may_depend_on_several_factors_reached(rule):
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 4, (20_000, 4))
    later = np.clip(codes + rng.integers(-1, 2, codes.shape), 0, 3)
    done, parents = {
        "cells": ((later[:, 0] + later[:, 1]) % 3 == 0, {(1, 0), (1, 1)}),
        "parity": ((later[:, 0] + later[:, 1]) % 2 == 0, {(1, 0), (1, 1)}),
        "three": ((later[:, 0] == 1) & (later[:, 1] == 2) & (later[:, 3] > 0), {(1, 0), (1, 1), (1, 3)}),
        "both slices": ((codes[:, 2] + later[:, 1]) % 2 == 0, {(0, 2), (1, 1)}),
        "lines": (later[:, 3] == 0, {(1, 3)}),
        "never": (later[:, 3] < 0, set()),
    }[rule]  # fmt: skip
    dbn, error = _ends(done, codes, later, 4)
    assert error < 0.01
    for name in ("termination", "reward"):
        assert set(dbn.step_tables[name].parents(0, 0)) == parents


def test_copies_of_a_parent_are_left_out():
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 4, (5000, 1))
    later = rng.integers(0, 4, (5000, 1))
    codes, later = np.repeat(codes, 3, 1), np.repeat(later, 3, 1)
    dbn, error = _ends((codes[:, 0] + later[:, 0]) % 3 == 0, codes, later, 4)
    assert error < 0.01 and len(dbn.step_tables["termination"].parents(0, 0)) == 2


def test_outcomes_that_do_not_fit_are_refused():
    dbn = from_experience(CODES, ACTIONS, LATER, num_values=2)
    steps, kind, rewards, ends = (CODES, ACTIONS, LATER), np.arange(30), np.zeros(30), np.zeros(30, bool)
    for given_steps, columns, message in (
        (steps, (kind + 1, rewards, ends), "kinds of steps .* found 30"),
        (steps, (kind - 1, rewards, ends), "kinds of steps .* found -1"),
        (steps, (kind, rewards[:20], ends), "rewards must be 30"),
        (steps, (kind, rewards * np.nan, ends), "rewards must be 30 finite"),
        (steps, (kind, rewards, ends + 2), "terminated"),
        (steps, (kind[:0], rewards[:0], ends[:0]), "no steps"),
        ((CODES, ACTIONS + 1, LATER), (kind, rewards, ends), "actions .* found 2"),
        ((CODES[:, :1], ACTIONS, LATER[:, :1]), (kind, rewards, ends), "2 factors, not 1"),
    ):
        with pytest.raises(UserError, match=message):
            with_outcomes(dbn, given_steps, *columns)


def test_a_codebook_holds_whole_numbers():
    codes = np.zeros((2, 1), dtype=np.uint8)
    with pytest.raises(UserError, match="views of a codebook are whole numbers"):
        Codebook.build(np.full((2, 1, 1), 0.5), codes, np.ones(2), None)
    with pytest.raises(UserError, match="views of a codebook are whole numbers"):
        Codebook.build(np.full((2, 1, 1), 256), codes, np.ones(2), None)
    with pytest.raises(UserError, match="codes of a codebook are whole numbers"):
        Codebook.build(np.zeros((2, 1, 1)), codes - 0.5, np.ones(2), None)
    wide = Codebook.build(np.zeros((2, 1, 1)), np.array([[1], [300]]), np.ones(2), None)
    assert wide.codes.tolist() == [[1], [300]]
    dbn = from_experience(CODES, ACTIONS, LATER, num_values=2)
    with pytest.raises(UserError, match="codes of the codebook"):
        with_observation(dbn, wide)
