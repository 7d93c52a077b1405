"""RDDL simulated by pyRDDLGym, PDDL solved by Fast Downward (the `check` extra), and their texts."""

from dataclasses import replace

import numpy as np
import pytest

from nesy import formats
from nesy.dbn.inference.exact import most_probable_next
from nesy.errors import UserError
from nesy.formats.programs.execution import by_fast_downward, execute
from nesy.formats.rddl import MAX_ENTRIES
from tests.nesy.dbn.extracted import extracted_run
from tests.nesy.dbn.models import all_codes, random_dbn, transition_matrix
from tests.nesy.dbn.steps import with_steps
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
def test_pyrddlgym_simulates_large_models_without_their_improbable_entries(tmp_path, monkeypatch):
    pyrddlgym = pytest.importorskip("pyRDDLGym")
    dbn = random_dbn(np.random.default_rng(9), num_factors=2, num_values=3, concentration=0.05)
    table = np.where(dbn.probabilities > 0.999, 0.0, dbn.probabilities) * 0.99
    rows = dbn.probabilities.argmax(axis=1)
    table[np.arange(len(table)), rows] += 1 - table.sum(axis=1)  # some rows are certain: 1.0 and zeros
    dbn = replace(dbn, probabilities=table, row_counts=np.ones_like(dbn.row_counts))
    monkeypatch.setattr("nesy.formats.rddl.MAX_ENTRIES", int((table >= 1e-6).sum()))
    start = np.array([1, 2])
    formats.export(dbn, tmp_path / "m.rddl", start=start)
    head = (tmp_path / "m.rddl").read_text().splitlines()[0]
    apart = np.where(table < 1e-6, table, 0).sum(axis=1).max()
    assert head == (
        f"// Entries below 1e-06 are left out; a row is at most {apart:.2g} from the model's in total variation."
    )
    environment = pyrddlgym.make(str(tmp_path / "m.rddl"), str(tmp_path / "m_instance.rddl"))
    environment.reset(seed=0)
    draws, counts = 800, np.zeros(9)
    for _ in range(draws):
        environment.reset()
        after, *_ = environment.step({"do_a1": True})
        counts[int(str(after["x0"])[1:]) * 3 + int(str(after["x1"])[1:])] += 1
    expected = transition_matrix(dbn, 1)[1 * 3 + 2]
    error = 4 * np.sqrt(expected * (1 - expected) / draws) + 2 * apart + 1e-9
    assert (np.abs(counts / draws - expected) <= error).all()


@pytest.mark.check
def test_pyrddlgym_knows_rewards_and_endings(tmp_path):
    pyrddlgym = pytest.importorskip("pyRDDLGym")
    rng = np.random.default_rng(6)
    dbn = with_steps(random_dbn(rng, num_factors=2, num_values=3, arcs=False), rng, next_parents=True)
    formats.export(dbn, tmp_path / "m.rddl", start=np.array([1, 2]))
    environment = pyrddlgym.make(str(tmp_path / "m.rddl"), str(tmp_path / "m_instance.rddl"))
    environment.reset(seed=0)
    rewards, ends, draws = [], [], 1000
    for _ in range(draws):
        environment.reset()
        _, reward, terminated, *_ = environment.step({"do_a0": True})
        rewards.append(reward)
        ends.append(terminated)
    codes, row = all_codes(dbn), transition_matrix(dbn, 0)[1 * 3 + 2]
    step = (np.tile([1, 2], (9, 1)), np.zeros(9, dtype=int), codes)
    pays = dbn.step_tables["reward"].look_up(*step)[:, 0, 0]
    ending = float(row @ dbn.step_tables["termination"].look_up(*step)[:, 0, 1])
    spread = np.sqrt(max(row @ pays**2 - (row @ pays) ** 2, 1e-12) / draws)
    assert abs(np.mean(rewards) - row @ pays) <= 4 * spread + 1e-9
    assert abs(np.mean(ends) - ending) <= 4 * np.sqrt(ending * (1 - ending) / draws) + 1e-9


@pytest.mark.check
def test_a_plan_of_fast_downward_reaches_its_goal_in_the_model():
    pytest.importorskip("up_fast_downward")
    solved = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        dbn = random_dbn(rng, num_factors=3, num_values=3, num_actions=3, concentration=0.1)
        codes = all_codes(dbn)
        start = codes[rng.integers(len(codes))]
        distance = shortest(dbn, start)
        goal = max(distance, key=distance.get)
        if distance[goal] == 0:
            continue
        plan = by_fast_downward(dbn, start, np.array([goal]))
        assert len(plan) == distance[goal]
        code = start
        for action, there in plan:
            code = most_probable_next(dbn, code[None], action)[0][0]
            assert tuple(code) == there
        assert tuple(code) == goal
        solved += 1
    assert solved >= 3


@pytest.mark.check
def test_plans_of_fast_downward_are_executed_in_the_environment():
    pytest.importorskip("up_fast_downward")
    from domains.core import load_domain
    from nesy.dbn.codebook import Codebook
    from nesy.dbn.model import TwoSliceDBN
    from nesy.world_model import SymbolicCodec, load_world_model

    _, run, _ = extracted_run()
    codec = SymbolicCodec(load_world_model(run.world_model))
    dbn, codebook = TwoSliceDBN.load(run.dbn), Codebook.load(run.dbn)
    # With the goal in view little that matters is hidden: the plans arrive, though this small model is a rough one.
    done = execute(load_domain(), "paper", dbn, codebook, codec.codes, 4, seed=0, outcomes=1, in_sight=True)
    assert done.episodes == 4 and done.calls >= 1
    assert done.reached >= 2 and done.unsolved < done.calls


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


def test_pddl_has_an_action_for_every_code_and_change(tmp_path):
    formats.export(toy()[0], tmp_path / "m.pddl", start=np.array([0, 1, 0]), goals=np.array([[1, 0, 0]]))
    domain = (tmp_path / "m.pddl").read_text()
    # swap: front takes the value of side, side that of front; codes are numbered in order, (0, 1, 0) is the third
    assert "(:action swap-2 :parameters ()" in domain
    assert (
        ":precondition (and (x0-0) (x1-1) (x2-0))\n    :effect (and (not (x0-0)) (x0-1) (not (x1-1)) (x1-0)))" in domain
    )
    assert "(:init (x0-0) (x1-1) (x2-0))" in (tmp_path / "m_problem.pddl").read_text()
    assert ":action-costs" not in domain


def test_pddl_of_the_reachable_part_and_of_several_outcomes(tmp_path):
    dbn = random_dbn(np.random.default_rng(0), concentration=0.3)
    start = np.array([0, 1, 2])
    formats.export(dbn, tmp_path / "all.pddl", start=start)
    formats.export(dbn, tmp_path / "part.pddl", start=start, reachable=True)
    formats.export(dbn, tmp_path / "more.pddl", start=start, outcomes=3, goal={0: 1})
    counts = [(tmp_path / f"{name}.pddl").read_text().count("(:action") for name in ("part", "all", "more")]
    assert 0 < counts[0] < counts[1] < counts[2]
    assert "minimize (total-cost)" in (tmp_path / "more_problem.pddl").read_text()
    assert "(:goal (and (x0-1)))" in (tmp_path / "more_problem.pddl").read_text()


def test_large_models_write_only_the_rows_met(tmp_path):
    from nesy.dbn.model import TwoSliceDBN

    table = np.full((8**5, 8), 1 / 8)
    dbn = TwoSliceDBN.from_tables([[table] * 5], [[list(range(5))] * 5])
    assert dbn.probabilities.size > MAX_ENTRIES
    counts = np.zeros(len(dbn.row_counts), dtype=np.int64)
    counts[:3] = 1
    formats.export(replace(dbn, row_counts=counts), tmp_path / "m.rddl")
    assert "never met" in (tmp_path / "m.rddl").read_text()
    assert (tmp_path / "m_instance.rddl").read_text().count("p_0_0(") == 24
    for too_many in (counts + 1, 0 * counts):  # all met, or no word about it
        with pytest.raises(UserError, match="at most"):
            formats.export(replace(dbn, row_counts=too_many), tmp_path / "m.rddl")


def test_pddl_of_a_model_that_does_not_know_its_codes(tmp_path):
    dbn = random_dbn(np.random.default_rng(0), num_factors=6, num_values=6, max_parents=1)
    with pytest.raises(UserError, match="codes"):
        formats.export(dbn, tmp_path / "m.pddl")
