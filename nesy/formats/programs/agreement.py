"""P(goal | plan) from a known code by independent programs (the `check` extra): pyAgrum and Storm.

Both are given only what the plan can really reach from the start (reached): pyAgrum the unrolled
network with the start as hard evidence, Storm the PRISM file. Everything left out has probability 0 there, so the
number is that of the whole model.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nesy.dbn.inference.plans import Reached, reached
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats import prism

Goal = Mapping[int, int]
"""{factor: value}"""


def own(dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int], goal: Goal) -> float:
    """By our own arithmetic: a forward pass over the codes that the plan can reach."""
    part = reached(dbn, np.asarray(start), plan, tuple(goal))
    there = np.all([part.codes[:, i] == v for i, v in goal.items()], axis=0)
    return float(part.weights[there].sum())


def by_pyagrum(dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int], goal: Goal) -> float:
    """By pyAgrum's lazy propagation on the unrolled network.

    Raises:
        UserError: pyAgrum is not installed.
    """
    gum = _imported("pyagrum")
    part = reached(dbn, np.asarray(start), plan, tuple(goal))
    if any(v not in part.values[-1][i] for i, v in goal.items()):
        return 0.0
    network = _unrolled(gum, dbn, plan, part)
    engine = gum.LazyPropagation(network)
    engine.setEvidence({f"x{i}_0": str(int(start[i])) for i in part.slices[0]})
    names = {i: f"x{i}_{len(plan)}" for i in goal}
    engine.addJointTarget(set(names.values()))
    engine.makeInference()
    joint = engine.jointPosterior(set(names.values()))
    place = gum.Instantiation(joint)
    place.fromdict({names[i]: str(v) for i, v in goal.items()})
    return float(joint.get(place))


def _unrolled(gum: Any, dbn: TwoSliceDBN, plan: Sequence[int], part: Reached) -> Any:
    network = gum.BayesNet("plan")
    for step, values in enumerate(part.values):
        for i, kept in values.items():
            network.add(gum.LabelizedVariable(f"x{i}_{step}", "", [str(v) for v in kept]))
    for i in part.slices[0]:
        network.cpt(f"x{i}_0").fillWith([1.0])
    for step, action in enumerate(plan):
        for i in (i for i in dbn.order if i in part.values[step + 1]):
            name, parents = f"x{i}_{step + 1}", dbn.parents(action, i)
            for where, p in parents:
                network.addArc(f"x{p}_{step + where}", name)
            index = [part.values[step + where][p] for where, p in parents]
            tensor = dbn.tensor(action, i)[np.ix_(*index, part.values[step + 1][i])]
            # combinations of parents that are never met together may have lost their values: any row will do there
            totals = tensor.sum(axis=-1, keepdims=True)
            tensor = np.where(totals > 0, tensor, 1.0 / tensor.shape[-1])
            axes = (*range(len(parents) - 1, -1, -1), len(parents))
            network.cpt(name).fillWith(tensor.transpose(axes).reshape(-1).tolist())
    return network


def by_storm(dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int], goal: Goal) -> float:
    """By Storm on the PRISM file of the plan.

    Raises:
        UserError: Storm is not installed.
    """
    stormpy = _imported("stormpy")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.prism"
        prism.write(dbn, path, np.asarray(start), plan, goal=goal)
        program = stormpy.parse_prism_program(str(path))
    properties = stormpy.parse_properties('P=? [F ("end" & "goal")]', program)
    model = stormpy.build_model(program, properties)
    result = stormpy.model_checking(model, properties[0])
    return float(result.get_value(model.initial_states[0]))


def _imported(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"{name} is not installed; it comes with: pip install 'nesy[check]'") from None
