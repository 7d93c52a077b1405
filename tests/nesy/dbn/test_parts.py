"""Parts of a model: the cone of influence, and the known part with its bounds; step tables."""

from dataclasses import replace

import numpy as np
import pytest

from nesy.dbn.inference.exact import plan_marginals
from nesy.dbn.inference.plans import follow, reached
from nesy.dbn.learning.step_learning import with_observation, with_outcomes
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.parts import cone_of, known_part
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.steps import with_steps
from tests.nesy.dbn.toy import experience, toy


def chain(rng, factors=5):
    """X_i' depends on X_{i-1}; the last factor depends on nothing."""
    table = rng.dirichlet(np.ones(3), size=3)
    tables = [table] * (factors - 1) + [rng.dirichlet(np.ones(3), size=1)]
    parents = [[max(0, i - 1)] for i in range(factors - 1)] + [[]]
    return TwoSliceDBN.from_tables([tables], [parents])


def test_the_cone_of_a_goal_is_a_smaller_model_with_the_same_probabilities():
    dbn = chain(np.random.default_rng(0))
    part = cone_of(dbn, [1])
    assert part.factor_names == ("X0", "X1")
    start = np.array([2, 1, 0, 0, 0])
    whole = plan_marginals(dbn, start, [0, 0, 0], (1,))
    np.testing.assert_allclose(plan_marginals(part, start[:2], [0, 0, 0], (1,)), whole, atol=1e-14)
    assert cone_of(dbn, [4]).factor_names == ("X4",)


@pytest.mark.parametrize("seed", range(6))
def test_the_cone_keeps_arcs_inside_the_next_slice_and_step_tables_that_fit(seed):
    rng = np.random.default_rng(seed)
    dbn = with_steps(random_dbn(rng, num_factors=5, max_parents=1), rng)
    part = cone_of(dbn, [int(dbn.order[0])], actions=[1])
    kept = [dbn.factor_names.index(name) for name in part.factor_names]
    assert part.action_names == ("a1",)
    start = rng.integers(0, 3, size=5)
    target = dbn.order[0]
    np.testing.assert_allclose(
        plan_marginals(part, start[kept], [0, 0], (kept.index(target),)),
        plan_marginals(dbn, start, [1, 1], (target,)),
        atol=1e-14,
    )
    reward = dbn.step_tables["reward"]
    assert ("reward" in part.step_tables) == all(p in kept for _, p in reward.parents(1, 0))
    if "reward" in part.step_tables:
        np.testing.assert_array_equal(part.step_tables["reward"].table(0, 0), reward.table(1, 0))


def test_wrong_cones_are_explained():
    dbn = chain(np.random.default_rng(0))
    for factors, actions in (([7], None), ([], None), ([0], [3])):
        with pytest.raises(UserError, match="lie"):
            cone_of(dbn, factors, actions)


@pytest.mark.parametrize("seed", range(8))
def test_the_known_part_bounds_the_whole_model(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=4)
    part = known_part(dbn, least=0.1)
    start, plan, factor = rng.integers(0, 3, size=4), rng.integers(0, 2, size=3).tolist(), int(rng.integers(4))
    whole = plan_marginals(dbn, start, plan, (factor,))
    low = plan_marginals(part, start, plan, (factor,))
    assert (low[:3] <= whole + 1e-12).all() and (whole <= low[:3] + low[3] + 1e-12).all()
    assert low.sum() == pytest.approx(1)


def test_the_known_part_of_a_model_met_everywhere_is_the_model():
    dbn = random_dbn(np.random.default_rng(1))
    dbn = replace(dbn, row_counts=np.ones_like(dbn.row_counts))
    part = known_part(dbn)
    start, plan = np.array([0, 1, 2]), [0, 1]
    codes, weights = follow(part, start, plan)
    assert codes.max() == 2
    np.testing.assert_allclose(weights, follow(dbn, start, plan)[1], atol=1e-14)


def test_what_a_plan_reaches_is_what_it_needs():
    rng = np.random.default_rng(3)
    dbn = random_dbn(rng, num_factors=4, zeros=True)
    start, plan = np.array([0, 1, 2, 0]), [0, 1, 1]
    part = reached(dbn, start, plan, (2,))
    blank = np.zeros_like(dbn.probabilities)
    blank[:, 0] = 1.0
    for step, a in enumerate(plan):
        for i, rows in part.rows[step].items():
            blank[dbn.offsets[a, i] + rows] = dbn.probabilities[dbn.offsets[a, i] + rows]
            values = np.flatnonzero((dbn.cpt(a, i)[rows] > 0).any(axis=0))
            assert part.values[step + 1][i].tolist() == values.tolist()
    # with every other row replaced the result is the same
    np.testing.assert_allclose(
        plan_marginals(replace(dbn, probabilities=blank), start, plan, (2,)),
        plan_marginals(dbn, start, plan, (2,)),
        atol=1e-14,
    )


def test_a_step_table_looks_rows_up():
    table = StepTable(("r",), (), 2, (((0,),), ((),)), (((1,),), ((),)), np.arange(5.0)[:, None], np.ones(5, np.int64))
    codes, later = np.array([[1, 0], [0, 0], [0, 1]]), np.array([[0, 1], [1, 0], [1, 1]])
    assert table.look_up(codes, np.array([0, 0, 1]), later)[:, 0, 0].tolist() == [3.0, 0.0, 4.0]


def test_outcomes_are_learned_with_parents_chosen_by_score():
    dbn, taken = toy()[0], experience()
    *steps, kind = taken.numbered()
    # the episode ends, and pays 2, when `go` is done with the front free and the goal ahead
    ends = (taken.actions == 1) & (taken.codes[:, 0] == 0) & (taken.codes[:, 2] == 1)
    many = np.tile(np.arange(len(ends)), 50)
    dbn = with_outcomes(dbn, steps, kind[many], 2.0 * ends[many], ends[many])
    termination, reward = dbn.step_tables["termination"], dbn.step_tables["reward"]
    assert termination.parents(0, 0) == () and {p for _, p in termination.parents(1, 0)} == {0, 2}
    chances = termination.look_up(taken.codes, taken.actions, taken.next_codes)[:, 0, 1]
    np.testing.assert_allclose(chances, ends, atol=1e-3)
    pay = reward.look_up(taken.codes, taken.actions, taken.next_codes)[:, 0, 0]
    np.testing.assert_allclose(pay, 2.0 * ends, atol=1e-3)
    assert int(termination.counts(0, 0).sum()) == 50 * 8


def test_the_observation_model_is_learned_from_the_codebook():
    dbn, codebook = toy()
    observation = with_observation(dbn, codebook).step_tables["observation"]
    assert observation.targets[4] == "cell_1_1" and observation.outcomes[1] == "wall"
    seen = observation.look_up(codebook.codes, np.zeros(8, dtype=int), codebook.codes).argmax(axis=-1)
    np.testing.assert_array_equal(seen.reshape(8, 3, 3), codebook.views)


def test_step_tables_that_do_not_fit_are_refused():
    ones = np.ones(1, np.int64)
    with pytest.raises(UserError, match="float64"):
        StepTable(("r",), (), 2, (((0,),),), (((),),), np.zeros((1, 1)), ones)
    with pytest.raises(UserError, match="distribution"):
        StepTable(("r",), ("a", "b"), 2, (((),),), (((),),), np.full((1, 2), 0.7), ones)
    with pytest.raises(UserError, match="finite"):
        StepTable(("r",), (), 2, (((),),), (((),),), np.full((1, 1), np.nan), ones)
    fitting = StepTable(("r",), (), 3, (((5,),),), (((),),), np.zeros((3, 1)), np.ones(3, np.int64))
    with pytest.raises(UserError, match="distinct factors"):
        replace(random_dbn(np.random.default_rng(0)), step_tables={"reward": fitting})
    with pytest.raises(UserError, match="no step table is called"):
        replace(random_dbn(np.random.default_rng(0)), step_tables={"price": fitting})
