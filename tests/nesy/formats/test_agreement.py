"""Independent tools read the files and compute the same numbers (the `check` extra)."""

import numpy as np
import pytest

from nesy import formats
from nesy.dbn.inference import plan_marginals
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.plans import cone, follow, pruned, reachable_values
from nesy.formats import prism
from nesy.formats.bayes_nodes import node_names
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.real import real_model

pytestmark = pytest.mark.check


def unrolled(gum, dbn: TwoSliceDBN, start, plan, factors):
    """Network of pyAgrum over the slices and values that matter, the start as hard evidence."""
    slices, sets = cone(dbn, plan, factors), reachable_values(dbn, start, plan)
    network = gum.BayesNet("plan")
    for step, used in enumerate(slices):
        for i in used:
            network.add(gum.LabelizedVariable(f"x{i}_{step}", "", [str(v) for v in sets[step][i]]))
    for i in slices[0]:
        network.cpt(f"x{i}_0").fillWith([1.0])
    for step, action in enumerate(plan):
        for i in dbn.order:
            if i not in slices[step + 1]:
                continue
            name = f"x{i}_{step + 1}"
            parents = [f"x{p}_{step + where}" for where, p in dbn.parents(action, i)]
            for parent in parents:
                network.addArc(parent, name)
            index = [sets[step + where][p] for where, p in dbn.parents(action, i)]
            tensor = dbn.tensor(action, i)[np.ix_(*index, sets[step + 1][i])]
            axes = (*range(len(parents) - 1, -1, -1), len(parents))
            network.cpt(name).fillWith(tensor.transpose(axes).reshape(-1).tolist())
    return network, {f"x{i}_0": str(int(start[i])) for i in slices[0]}


def by_pyagrum(dbn, start, plan, goal):
    gum = pytest.importorskip("pyagrum")
    network, evidence = unrolled(gum, dbn, start, plan, tuple(goal))
    engine = gum.LazyPropagation(network)
    engine.setEvidence(evidence)
    names = [f"x{i}_{len(plan)}" for i in goal]
    engine.addJointTarget(set(names))
    engine.makeInference()
    joint = engine.jointPosterior(set(names))
    labels = {name: str(value) for name, value in zip(names, goal.values(), strict=True)}
    if any(label not in network.variable(name).labels() for name, label in labels.items()):
        return 0.0
    place = gum.Instantiation(joint)
    place.fromdict(labels)
    return float(joint.get(place))


def by_storm(dbn, start, plan, goal, tmp_path):
    stormpy = pytest.importorskip("stormpy")
    path = tmp_path / "plan.prism"
    path.write_text(prism.model_text(dbn, start, plan, tuple(goal)))
    program = stormpy.parse_prism_program(str(path))
    wanted = " & ".join(f"x{i}={v}" for i, v in goal.items())
    formula = f'P=? [F ("end" & {wanted})]'
    properties = stormpy.parse_properties(formula, program)
    model = stormpy.build_model(program, properties)
    result = stormpy.model_checking(model, properties[0])
    return float(result.get_value(model.initial_states[0]))


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("arcs", [False, True])
def test_three_programs_agree_on_the_probability_of_a_goal_after_a_plan(seed, arcs, tmp_path):
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
    assert by_storm(dbn, start, plan, goal, tmp_path) == pytest.approx(own, abs=1e-9)


def test_three_programs_agree_on_a_model_of_the_real_domain(tmp_path):
    base = real_model()
    dbn, lost = pruned(base.dbn, 0.01)
    assert lost < 0.1
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(10):
        start = base.codebook.codes[rng.integers(len(base.codebook))].astype(int)
        plan = rng.integers(0, 4, size=int(rng.integers(1, 4))).tolist()
        factor = int(rng.integers(8))
        codes, weights = follow(dbn, start, plan, (factor,))
        value = int(codes[weights.argmax(), factor])
        own = float(weights[codes[:, factor] == value].sum())
        goal = {factor: value}
        assert by_pyagrum(dbn, start, plan, goal) == pytest.approx(own, abs=1e-9)
        assert by_storm(dbn, start, plan, goal, tmp_path) == pytest.approx(own, abs=1e-9)
        compared += 0.01 < own < 0.99
    assert compared >= 2


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
    dbn = random_dbn(np.random.default_rng(1))
    formats.export(dbn, tmp_path / f"m.{name}")
    network = gum.loadBN(str(tmp_path / f"m.{name}"))
    now, later = node_names(dbn)
    assert set(network.names()) == set(now) | {n for names in later for n in names}
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


def test_one_step_inference_is_at_least_five_times_faster_than_pyagrum_s():
    import time

    gum = pytest.importorskip("pyagrum")
    from nesy.dbn.factored import FactoredUpdates

    rng = np.random.default_rng(0)
    dbn = random_dbn(rng, num_factors=8, num_values=8, arcs=False, max_parents=3)
    codes = rng.integers(0, 8, size=(50, 8))
    updates = FactoredUpdates(dbn)
    beliefs, actions = np.eye(8)[codes], np.zeros(50, dtype=np.int64)
    updates.predict(beliefs, actions)
    started = time.perf_counter()
    ours = updates.predict(beliefs, actions)
    own = time.perf_counter() - started
    network = gum.BayesNet("step")
    for i in range(8):
        network.add(gum.RangeVariable(f"x{i}_0", "", 0, 7))
        network.cpt(f"x{i}_0").fillWith([1 / 8] * 8)
    for i in range(8):
        network.add(gum.RangeVariable(f"x{i}_1", "", 0, 7))
        parents = dbn.parents_now[0][i]
        for p in parents:
            network.addArc(f"x{p}_0", f"x{i}_1")
        axes = (*range(len(parents) - 1, -1, -1), len(parents))
        network.cpt(f"x{i}_1").fillWith(dbn.tensor(0, i).transpose(axes).reshape(-1).tolist())
    engine = gum.LazyPropagation(network)
    started = time.perf_counter()
    for b, code in enumerate(codes):
        engine.setEvidence({f"x{i}_0": int(v) for i, v in enumerate(code) if f"x{i}_0" in network.names()})
        engine.makeInference()
        theirs = [engine.posterior(f"x{i}_1").tolist() for i in range(8)]
        np.testing.assert_allclose(ours[b], theirs, atol=1e-9)
    assert own * 5 < time.perf_counter() - started
