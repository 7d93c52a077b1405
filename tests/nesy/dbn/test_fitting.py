"""Structure and rows recovered from transitions."""

import numpy as np
import pytest

from nesy.dbn.evaluation.measures import fidelity
from nesy.dbn.evaluation.recovery import compare_arcs, random_model, random_transitions, recover
from nesy.dbn.learning.extraction import extract
from nesy.dbn.learning.fitting import from_callable, from_experience
from nesy.dbn.learning.structure import Search
from nesy.errors import UserError
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
    from nesy.dbn.learning.extraction import with_counts

    taken = experience()
    codes, actions, later, counts = taken.distinct()
    assert counts.sum() == len(taken.codes) and len(counts) == 16
    dbn = toy()[0]
    whole = with_counts(dbn, taken.codes, taken.actions, taken.next_codes)
    short = with_counts(dbn, codes, actions, later, counts)
    np.testing.assert_array_equal(whole.row_counts, short.row_counts)
    for name in ("codes", "taken", "changed"):
        np.testing.assert_array_equal(whole.tables[name], short.tables[name])
