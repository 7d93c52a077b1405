"""RDDL simulated by pyRDDLGym, PDDL solved by Fast Downward (the `check` extra), and their texts."""

import numpy as np
import pytest

from nesy import formats
from nesy.dbn.inference import most_probable_next
from nesy.errors import UserError
from nesy.formats.rddl import MAX_ENTRIES
from tests.nesy.dbn.models import all_codes, random_dbn, transition_matrix
from tests.nesy.dbn.toy import toy


@pytest.mark.check
@pytest.mark.parametrize("arcs", [False, True])
def test_pyrddlgym_simulates_the_model_within_its_sampling_error(tmp_path, arcs):
    pyrddlgym = pytest.importorskip("pyRDDLGym")
    dbn = random_dbn(np.random.default_rng(5), num_factors=2, num_values=3, arcs=arcs)
    start = np.array([1, 2])
    formats.export(dbn, tmp_path / "m.rddl", start=start)
    environment = pyrddlgym.make(str(tmp_path / "m.rddl"), str(tmp_path / "m_instance.rddl"))
    draws = 1500
    counts = np.zeros(9)
    environment.reset(seed=0)
    for _ in range(draws):
        environment.reset()
        after, *_ = environment.step({"do_a1": True})
        counts[int(str(after["x0"])[1:]) * 3 + int(str(after["x1"])[1:])] += 1
    expected = transition_matrix(dbn, 1)[1 * 3 + 2]
    error = 4 * np.sqrt(expected * (1 - expected) / draws) + 1e-9
    assert (np.abs(counts / draws - expected) <= error).all()


@pytest.mark.check
def test_a_plan_of_fast_downward_reaches_its_goal_in_the_model(tmp_path):
    pytest.importorskip("up_fast_downward")
    from unified_planning.io import PDDLReader
    from unified_planning.shortcuts import OneshotPlanner, get_environment

    get_environment().credits_stream = None
    solved = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        dbn = random_dbn(rng, num_factors=3, num_values=3, num_actions=3, concentration=0.1)
        codes = all_codes(dbn)
        start = codes[rng.integers(len(codes))]
        distance = shortest(dbn, start, beam=1)
        goal = max(distance, key=distance.get)
        if distance[goal] == 0:
            continue
        formats.export(dbn, tmp_path / "m.pddl", start=start, goals=np.array([goal]))
        problem = PDDLReader().parse_problem(str(tmp_path / "m.pddl"), str(tmp_path / "m_problem.pddl"))
        with OneshotPlanner(name="fast-downward") as planner:
            result = planner.solve(problem)
        steps = [action.action.name for action in result.plan.actions]
        assert steps[-1] == "arrive-0" and len(steps) >= distance[goal] + 1
        code = start
        for step in steps[:-1]:
            code = most_probable_next(dbn, code[None], dbn.action_names.index(step), beam=1)[0][0]
        assert tuple(code) == goal
        solved += 1
    assert solved >= 3


def shortest(dbn, start, beam=16):
    """Steps of most probable outcomes to every code that can be reached."""
    distance = {tuple(int(v) for v in start): 0}
    waiting = list(distance)
    while waiting:
        code = waiting.pop(0)
        for action in range(dbn.num_actions):
            later = tuple(int(v) for v in most_probable_next(dbn, np.array([code]), action, beam)[0][0])
            if later not in distance:
                distance[later] = distance[code] + 1
                waiting.append(later)
    return distance


def test_pddl_has_a_conditional_effect_for_every_context_that_changes_something(tmp_path):
    formats.export(toy()[0], tmp_path / "m.pddl", start=np.array([0, 1, 0]), goals=np.array([[1, 0, 0]]))
    domain = (tmp_path / "m.pddl").read_text()
    # swap: front takes the value of side, whatever it was
    assert "(when (and (x1-1)) (and (not (x0-0)) (not (x0-2)) (x0-1)))" in domain
    # go: the side opens up where the front is free
    assert "(when (and (x0-0) (x1-1)) (and (not (x1-1)) (x1-0)))" in domain
    assert "(:init (x0-0) (x1-1) (x2-0))" in (tmp_path / "m_problem.pddl").read_text()


def test_large_models_write_only_the_rows_met(tmp_path):
    from dataclasses import replace

    from nesy.dbn.model import TwoSliceDBN

    table = np.full((8**5, 8), 1 / 8)
    dbn = TwoSliceDBN.from_tables([[table] * 5], [[list(range(5))] * 5])
    assert dbn.probabilities.size > MAX_ENTRIES
    counts = np.zeros(len(dbn.row_counts), dtype=np.int64)
    counts[:3] = 1
    formats.export(replace(dbn, row_counts=counts), tmp_path / "m.rddl")
    assert "never met" in (tmp_path / "m.rddl").read_text()
    assert (tmp_path / "m_instance.rddl").read_text().count("p_0_0(") == 24
    with pytest.raises(UserError, match="at most"):
        formats.export(replace(dbn, row_counts=counts + 1), tmp_path / "m.rddl")


def test_pddl_of_a_model_that_does_not_know_its_codes(tmp_path):
    dbn = random_dbn(np.random.default_rng(0), num_factors=6, num_values=6, max_parents=1)
    with pytest.raises(UserError, match="codes"):
        formats.export(dbn, tmp_path / "m.pddl")
