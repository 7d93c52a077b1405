"""Plans against breadth-first search, beliefs against their definition, what holds after a plan."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.asp import KnowledgeBase
from nesy.asp.questions.aftermath import after
from nesy.asp.questions.planning import PredicateTruth, find_plan
from nesy.errors import UserError
from tests.nesy.dbn.models import all_codes, random_dbn, transition_matrix
from tests.nesy.dbn.toy import toy
from tests.nesy.formats.test_planning_files import shortest


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_plans_are_shortest_and_their_probabilities_exact(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=3, num_values=3, num_actions=3, concentration=0.2)
    codes = all_codes(dbn)
    start = codes[rng.integers(27)]
    distance = shortest(dbn, start)
    value = int(rng.integers(3))
    there = [d for code, d in distance.items() if code[1] == value]
    plan = find_plan(dbn, None, start, f"X1={value}", max_steps=27, most_probable=bool(seed % 2))
    if not there:
        assert plan.actions is None and plan.exhausted
        return
    assert plan.actions is not None and len(plan.actions) == min(there)
    chain = [tuple(code) for code in plan.codes]
    assert chain[0] == tuple(start) and chain[-1][1] == value
    matrices = [transition_matrix(dbn, a) for a in range(3)]
    number = {tuple(code): x for x, code in enumerate(codes)}
    steps = [dbn.action_names.index(name) for name in plan.actions]
    path = np.prod([matrices[a][number[c], number[d]] for a, c, d in zip(steps, chain, chain[1:], strict=False)])
    assert plan.path_probability == pytest.approx(path)
    distribution = np.eye(27)[number[chain[0]]]
    for a in steps:
        distribution = distribution @ matrices[a]
    goal = distribution[codes[:, 1] == value].sum()
    assert plan.goal_probability - 1e-12 <= goal <= plan.goal_probability + plan.dropped + 1e-12
    assert plan.dropped < 0.01


def test_most_probable_of_the_shortest_plans():
    # two actions lead from 0 to 1; the second is surer
    from nesy.dbn.model import TwoSliceDBN

    dbn = TwoSliceDBN.from_tables(
        [[np.array([[0.4, 0.6], [0.0, 1.0]])], [np.array([[0.1, 0.9], [0.0, 1.0]])]], [[[0]], [[0]]]
    )
    plan = find_plan(dbn, None, np.array([0]), "X0=1", most_probable=True)
    assert plan.actions == ("a1",) and plan.path_probability == pytest.approx(0.9)


def test_the_most_probable_trajectory_may_count_on_improbable_outcomes():
    from nesy.dbn.model import TwoSliceDBN

    # from 0, action 0 leads to 2 now and then, action 1 more often; the most probable outcome of both is 0
    rows = [np.array([[0.9, 0.0, 0.1], [0, 1, 0], [0, 0, 1]]), np.array([[0.7, 0.0, 0.3], [0, 1, 0], [0, 0, 1]])]
    dbn = TwoSliceDBN.from_tables([[rows[0]], [rows[1]]], [[[0]], [[0]]])
    assert find_plan(dbn, None, np.array([0]), "X0=2").actions is None
    plan = find_plan(dbn, None, np.array([0]), "X0=2", optimistic=True, most_probable=True)
    assert plan.actions == ("a1",) and plan.path_probability == pytest.approx(0.3)
    assert plan.goal_probability == pytest.approx(0.3)
    assert find_plan(dbn, None, np.array([0]), "X0=1", optimistic=True).actions is None


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_the_most_probable_trajectory_is_that_of_dynamic_programming(seed, with_rule):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=2, num_values=3, num_actions=2, concentration=0.3)
    codes = all_codes(dbn)
    matrices = [transition_matrix(dbn, a) for a in range(2)]
    usable = [np.where(matrix >= 0.01, matrix, 0.0) for matrix in matrices]
    for matrix, certain in zip(usable, matrices, strict=True):
        matrix[np.arange(9), certain.argmax(axis=1)] = certain.max(axis=1)
    if with_rule:
        usable = usable[:1]
    start, good = int(rng.integers(9)), codes[:, 0] == 2
    best, here = 0.0, np.eye(9)[start]
    for _ in range(5):
        best = max(best, here[good].max())
        here = np.max([(here[:, None] * matrix).max(axis=0) for matrix in usable], axis=0)
    rules = [":- do(a1,T)."] if with_rule else []
    plan = find_plan(dbn, None, codes[start], "X0=2", 4, rules, most_probable=True, optimistic=True, any_length=True)
    assert plan.path_probability == pytest.approx(best, rel=0.01)
    assert (plan.actions is None) == (best == 0)


def test_the_user_s_rules_constrain_the_plan(tmp_path):
    dbn, codebook = toy()
    start = np.array([0, 1, 0])
    assert find_plan(dbn, codebook, start, "all_free").actions == ("go",)
    rules = tmp_path / "rules.lp"
    rules.write_text(":- do(go,T), at(C,T), not now(C,wall_ahead).\n")
    assert find_plan(dbn, codebook, start, "all_free", max_steps=4, rules=[rules]).actions is None
    assert find_plan(dbn, codebook, start, "wall_ahead", rules=[rules]).actions == ("swap",)
    rules.write_text(":- do(go T).")
    with pytest.raises(UserError, match=r"rules\.lp:1"):
        find_plan(dbn, codebook, start, "all_free", rules=[rules])


def test_goals_with_predicates_and_goals_that_hold_already():
    dbn, codebook = toy()
    assert find_plan(dbn, codebook, np.array([1, 0, 1]), "goal_visible, not wall_ahead").actions == ("swap",)
    assert find_plan(dbn, codebook, np.array([1, 0, 1]), "goal_visible").actions == ()
    assert find_plan(dbn, codebook, np.array([1, 0, 0]), "goal_visible").actions is None
    with pytest.raises(UserError, match="goal"):
        find_plan(dbn, codebook, np.array([1, 0, 0]), "")


def test_what_holds_after_a_plan():
    dbn, codebook = toy()
    result = after(dbn, PredicateTruth(codebook), np.array([1, 0, 1]), [0])
    assert result.must == ("goal_visible",) and "wall_ahead" in result.cannot
    assert result.codes == 1 and result.unknown == 0
    # a value that no view has: nothing is known
    assert after(dbn, PredicateTruth(codebook), np.array([0, 0, 2]), [0]).unknown == 1


@pytest.mark.parametrize("least", [0.0, 1e-3, 0.2, 0.9])
def test_improbable_outcomes_are_left_out_and_that_is_said(least):
    dbn, codebook = toy()
    table = 0.7 * dbn.probabilities + 0.1
    noisy = replace(dbn, probabilities=table / table.sum(axis=1, keepdims=True))
    result = after(noisy, PredicateTruth(codebook), np.array([1, 0, 1]), [0], least)
    codes = np.array(list(np.ndindex(3, 3, 3)))
    chances = np.exp(noisy.log_prob(np.array([1, 0, 1]), 0, codes))
    kept = chances >= least if (chances >= least).any() else chances == chances.max()
    assert result.codes == kept.sum() and result.dropped == pytest.approx(1 - chances[kept].sum())
    holds, fails = PredicateTruth(codebook).of(codes[kept])
    assert result.must == tuple(n for n, all_ in zip(codebook.predicate_names, holds.all(0), strict=True) if all_)
    assert result.cannot == tuple(n for n, all_ in zip(codebook.predicate_names, fails.all(0), strict=True) if all_)


def test_knowledge_is_what_all_particles_agree_on():
    dbn, codebook = toy()
    base = KnowledgeBase(dbn, codebook)
    rng = np.random.default_rng(0)
    for _ in range(20):
        particles = rng.integers(0, 2, size=(int(rng.integers(1, 6)), 3)).astype(np.uint8)
        truth = {"wall_ahead": particles[:, 0] == 1, "goal_visible": particles[:, 2] == 1}
        truth["all_free"] = (particles == 0).all(axis=1)
        for row in base.knows(particles, list(truth)).rows:
            here = truth[row["predicate"]]
            assert row["knows"] == here.all() and row["knows_not"] == (~here).all()
            assert row["possible"] == here.any() and row["possible_not"] == (~here).any()


def test_a_world_never_met_leaves_everything_open():
    base = KnowledgeBase(*toy())
    (row,) = base.knows(np.array([[2, 2, 2], [1, 0, 0]], dtype=np.uint8), ["wall_ahead"]).rows
    assert (row["knows"], row["knows_not"], row["possible"], row["possible_not"]) == (False, False, True, True)
    with pytest.raises(UserError, match="particle"):
        base.knows(np.zeros((0, 3), dtype=np.uint8), ["wall_ahead"])


def test_views_that_share_a_code_and_disagree_leave_a_predicate_open():
    from nesy.dbn.codebook import Codebook
    from tests.nesy.dbn.toy import Predicates, all_views

    book = Codebook.build(all_views()[:2], np.zeros((2, 3), dtype=np.uint8), np.ones(2), Predicates())
    holds, fails = PredicateTruth(book).of(np.zeros((1, 3), dtype=np.uint8))
    assert not holds[0, 0] and not fails[0, 0]
    assert fails[0, 1]


def test_ready_questions_have_texts():
    base = KnowledgeBase(*toy())
    assert "go" in base.plan([0, 1, 0], "all_free").text
    assert "must hold: goal_visible" in base.after([1, 0, 1], ["swap"]).text
    assert "Proved" in base.verify("go", "front=1", "same").text
    assert "Not so" in base.verify("swap", "front=1", "same").text
    assert "known to be true" in base.knows(np.array([[1, 0, 0]], dtype=np.uint8), ["wall_ahead"]).text
    assert "front = 1" in base.rules("wall_ahead", held_out=0.0).text
