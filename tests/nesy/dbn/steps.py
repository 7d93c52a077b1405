"""Random observation, reward and termination tables for the tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable


def with_steps(dbn: TwoSliceDBN, rng: np.random.Generator, next_parents: bool = False) -> TwoSliceDBN:
    """The model with a random reward, termination and observation table."""
    n, k, actions = dbn.num_factors, dbn.num_values, dbn.num_actions

    def table(targets, outcomes, groups, observed=False):
        now = tuple(tuple((int(rng.integers(n)),) if not observed else () for _ in targets) for _ in range(groups))
        later = tuple(
            tuple((int(rng.integers(n)),) if observed or next_parents else () for _ in targets) for _ in range(groups)
        )
        sizes = sum(k ** (len(now[a][t]) + len(later[a][t])) for a in range(groups) for t in range(len(targets)))
        if outcomes:
            values = rng.dirichlet(np.ones(len(outcomes)), size=sizes)
        else:
            values = rng.normal(size=(sizes, 1)) ** 2
        return StepTable(targets, outcomes, k, now, later, values, rng.integers(1, 5, size=sizes))

    steps = {
        "reward": table(("reward",), (), actions),
        "termination": table(("done",), ("goes_on", "ends"), actions),
        "observation": table(("cell_0_0", "cell_0_1"), ("empty", "wall", "goal"), 1, observed=True),
    }
    return replace(dbn, step_tables=steps)
