"""Independent tools read the files and compute the same numbers (the `check` extra)."""

import numpy as np
import pytest

from nesy import formats
from nesy.dbn.inference.exact import plan_marginals
from nesy.dbn.inference.plans import follow, reached
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.parts import known_part
from nesy.formats.bayes_nodes import node_names
from nesy.formats.programs import agreement
from nesy.formats.programs.agreement import by_pyagrum, by_storm
from tests.nesy.dbn.extracted import extracted_run
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.steps import with_steps

pytestmark = pytest.mark.check


pytest.importorskip("pyagrum")
pytest.importorskip("stormpy")


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("arcs", [False, True])
def test_three_programs_agree_on_the_probability_of_a_goal_after_a_plan(seed, arcs):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, num_factors=4, num_values=3, arcs=arcs, zeros=seed % 2 == 1)
    start = rng.integers(0, 3, size=4)
    plan = rng.integers(0, 2, size=int(rng.integers(1, 6))).tolist()
    goal = {int(i): int(rng.integers(0, 3)) for i in rng.choice(4, size=int(rng.integers(1, 3)), replace=False)}
    own = float(plan_marginals(dbn, start, plan, tuple(goal))[tuple(goal.values())])
    codes, weights = follow(dbn, start, plan, tuple(goal))
    followed = weights[np.all([codes[:, i] == v for i, v in goal.items()], axis=0)].sum()
    assert own == pytest.approx(float(followed), abs=1e-12)
    assert by_pyagrum(dbn, start, plan, goal) == pytest.approx(own, abs=1e-9)
    assert by_storm(dbn, start, plan, goal) == pytest.approx(own, abs=1e-9)


def test_three_programs_agree_on_the_extracted_model():
    """Ten random plans of one to four steps on the known part; where it is one step, on the whole model too."""
    _, run, _ = extracted_run()
    whole = TwoSliceDBN.load(run.dbn)
    part = known_part(whole, 0.02)
    rng = np.random.default_rng(0)
    codes = whole.tables["codes"]
    likely = 0
    for number in range(10):
        start = codes[rng.integers(len(codes))].astype(int)
        plan = rng.integers(4, size=1 + number % 4).tolist()
        factor = int(rng.integers(8))
        used = reached(part, start, plan, (factor,))
        chances = np.bincount(used.codes[:, factor], used.weights, 9)
        goal = {factor: int(chances[:8].argmax())}
        mine = agreement.own(part, start, plan, goal)
        assert by_pyagrum(part, start, plan, goal) == pytest.approx(mine, abs=1e-9)
        assert by_storm(part, start, plan, goal) == pytest.approx(mine, abs=1e-9)
        likely += mine > 0.05
        if len(plan) == 1:
            exact = agreement.own(whole, start, plan, goal)
            assert mine - 1e-12 <= exact <= mine + chances[8] + 1e-12
            assert by_pyagrum(whole, start, plan, goal) == pytest.approx(exact, abs=1e-9)
            assert by_storm(whole, start, plan, goal) == pytest.approx(exact, abs=1e-9)
    assert likely >= 4


@pytest.mark.parametrize("arcs", [False, True])
def test_storm_finds_the_best_policy_of_the_exported_process(arcs, tmp_path):
    stormpy = pytest.importorskip("stormpy")
    dbn = random_dbn(np.random.default_rng(3), arcs=arcs)
    formats.export(dbn, tmp_path / "m.prism")
    program = stormpy.parse_prism_program(str(tmp_path / "m.prism"))
    properties = stormpy.parse_properties("Pmax=? [F x0=1]", program)
    model = stormpy.build_model(program, properties)
    steps = by_value_iteration(dbn, target=(0, 1))
    result = stormpy.model_checking(model, properties[0])
    assert result.get_value(model.initial_states[0]) == pytest.approx(steps, abs=1e-4)


@pytest.mark.parametrize("arcs", [False, True])
@pytest.mark.parametrize("next_parents", [False, True])
def test_storm_knows_rewards_and_endings(arcs, next_parents, tmp_path):
    import stormpy

    rng = np.random.default_rng(8)
    dbn = with_steps(random_dbn(rng, num_factors=2, arcs=arcs), rng, next_parents)
    formats.export(dbn, tmp_path / "m.prism")
    program = stormpy.parse_prism_program(str(tmp_path / "m.prism"))
    properties = stormpy.parse_properties('R{"reward"}max=? [F "done"]', program)
    model = stormpy.build_model(program, properties)
    result = stormpy.model_checking(model, properties[0])
    assert result.get_value(model.initial_states[0]) == pytest.approx(best_return(dbn), rel=1e-4)


def best_return(dbn):
    """The most that can be earned until the end, by value iteration over whole codes."""
    from tests.nesy.dbn.models import all_codes, transition_matrix

    codes = all_codes(dbn)
    size = len(codes)
    now, later = np.repeat(codes, size, axis=0), np.tile(codes, (size, 1))
    pays, goes_on = [], []
    for a in range(dbn.num_actions):
        taken = np.full(size * size, a)
        matrix = transition_matrix(dbn, a)
        reward = dbn.step_tables["reward"].look_up(now, taken, later)[:, 0, 0].reshape(size, size)
        ends = dbn.step_tables["termination"].look_up(now, taken, later)[:, 0, 1].reshape(size, size)
        pays.append((matrix * reward).sum(axis=1))
        goes_on.append(matrix * (1 - ends))
    value = np.zeros(size)
    for _ in range(3000):
        value = np.max([pay + on @ value for pay, on in zip(pays, goes_on, strict=True)], axis=0)
    start = int(np.ravel_multi_index(dbn.initial.argmax(axis=1), (dbn.num_values,) * dbn.num_factors))
    return float(value[start])


def by_value_iteration(dbn, target):
    from tests.nesy.dbn.models import all_codes, transition_matrix

    codes = all_codes(dbn)
    goal = codes[:, target[0]] == target[1]
    matrices = [transition_matrix(dbn, a) for a in range(dbn.num_actions)]
    value = goal.astype(float)
    for _ in range(2000):
        value = np.where(goal, 1.0, np.max([matrix @ value for matrix in matrices], axis=0))
    start = int(np.ravel_multi_index(dbn.initial.argmax(axis=1), (dbn.num_values,) * dbn.num_factors))
    return float(value[start])


@pytest.mark.parametrize("name", ["jgum", "bif"])
def test_pyagrum_reads_the_bayesian_network(name, tmp_path):
    gum = pytest.importorskip("pyagrum")
    rng = np.random.default_rng(1)
    dbn = with_steps(random_dbn(rng), rng)
    formats.export(dbn, tmp_path / f"m.{name}")
    network = gum.loadBN(str(tmp_path / f"m.{name}"))
    now, later = node_names(dbn)
    steps = {"cell_0_0", "cell_0_1", "done__a0", "done__a1"}
    assert set(network.names()) == set(now) | {n for names in later for n in names} | steps
    assert network.variable("cell_0_0").domainSize() == 3 and network.variable("done__a1").domainSize() == 2
    tolerance = 0 if name == "jgum" else 1e-7
    for a in range(dbn.num_actions):
        for i in range(dbn.num_factors):
            parents = [(now, later[a])[where][p] for where, p in dbn.parents(a, i)]
            table = network.cpt(later[a][i])
            # pyAgrum's arrays have the last parent first
            array = np.asarray(table.toarray()).transpose(
                [list(reversed(table.names)).index(p) for p in (*parents, later[a][i])]
            )
            np.testing.assert_allclose(array, dbn.tensor(a, i), rtol=0, atol=tolerance)
