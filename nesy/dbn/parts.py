"""Parts of a model that are models themselves, so that every format and all inference work on them.

`cone_of` keeps the factors that a goal depends on. `known_part` keeps the rows that experience has met.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError

ELSEWHERE = "elsewhere"
"""Meaning of the value that `known_part` adds to every factor."""


def cone_of(dbn: TwoSliceDBN, factors: Iterable[int], actions: Iterable[int] | None = None) -> TwoSliceDBN:
    """The model of some factors and of all that they depend on, at once or later.

    Args:
        dbn: the model.
        factors: the factors of the goal.
        actions: the actions that may be taken; all by default. Others are left out.

    Returns:
        A model of fewer factors (names and order kept) in which every probability of them is what it was. Step
        tables stay where all their parents do; codes met are cut down.

    Raises:
        UserError: no such factor or action.
    """
    taken = list(range(dbn.num_actions)) if actions is None else sorted(set(actions))
    if not all(0 <= a < dbn.num_actions for a in taken) or not taken:
        raise UserError(f"an action lies in 0..{dbn.num_actions - 1}")
    needed, waiting = set[int](), set(factors)
    if not waiting or not all(0 <= i < dbn.num_factors for i in waiting):
        raise UserError(f"the factors of a goal lie in 0..{dbn.num_factors - 1}, at least one")
    while waiting:
        needed |= waiting
        waiting = {p for a in taken for i in waiting for _, p in dbn.parents(a, i)} - needed
    kept = sorted(needed)
    place = {factor: position for position, factor in enumerate(kept)}

    def moved(parents: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(place[p] for p in parents)

    tables = dict(dbn.tables)
    if "codes" in tables:
        tables["codes"] = np.unique(tables["codes"][:, kept], axis=0)
    if "taken" in tables:
        tables["taken"] = tables["taken"][taken]
    if "changed" in tables:
        tables["changed"] = tables["changed"][np.ix_(taken, kept)]
    part = TwoSliceDBN.from_tables(
        [[dbn.cpt(a, i) for i in kept] for a in taken],
        [[moved(dbn.parents_now[a][i]) for i in kept] for a in taken],
        [[moved(dbn.parents_next[a][i]) for i in kept] for a in taken],
        action_names=[dbn.action_names[a] for a in taken],
        factor_names=[dbn.factor_names[i] for i in kept],
        order=[place[i] for i in dbn.order if i in place],
        counts=[[dbn.counts(a, i) for i in kept] for a in taken],
        initial=dbn.initial[kept],
        value_meanings=[dbn.value_meanings[i] for i in kept] if dbn.value_meanings else (),
        provenance={**dbn.provenance, "part": [dbn.factor_names[i] for i in kept]},
    )
    steps = {
        name: _moved(table, place, taken) for name, table in dbn.step_tables.items() if _inside(table, place, taken)
    }
    return replace(part, tables=tables, step_tables=steps)


def _inside(table: StepTable, place: dict[int, int], actions: list[int]) -> bool:
    return all(p in place for a in actions for t in range(len(table.targets)) for _, p in table.parents(a, t))


def _moved(table: StepTable, place: dict[int, int], actions: list[int]) -> StepTable:
    groups = actions if len(table.parents_now) > 1 else [0]
    pairs = [(a, t) for a in groups for t in range(len(table.targets))]
    return StepTable(
        targets=table.targets,
        outcomes=table.outcomes,
        num_values=table.num_values,
        parents_now=tuple(tuple(tuple(place[p] for p in ps) for ps in table.parents_now[a]) for a in groups),
        parents_next=tuple(tuple(tuple(place[p] for p in ps) for ps in table.parents_next[a]) for a in groups),
        values=np.concatenate([table.table(a, t) for a, t in pairs]),
        row_counts=np.concatenate([table.counts(a, t) for a, t in pairs]),
    )


def known_part(dbn: TwoSliceDBN, least: float = 0.0) -> TwoSliceDBN:
    """The model cut down to what experience supports, with one more value per factor for all the rest.

    The value `elsewhere` (number K) takes the mass of entries below `least` and of rows never met, and is never left
    again: a factor with a parent elsewhere is elsewhere. So for every plan and every goal on kept values

        P_part(goal) <= P(goal) <= P_part(goal) + P_part(a factor of the goal is elsewhere)

    and reachable values stay few, so that files are small and inference is exact where the whole model is too dense.
    Step tables are left out.

    Args:
        dbn: the model.
        least: least probability of an entry that is kept.

    Raises:
        UserError: a table would become too large.
    """
    k = dbn.num_values
    tables: list[list[np.ndarray]] = []
    counts: list[list[np.ndarray]] = []
    for a in range(dbn.num_actions):
        tables.append([])
        counts.append([])
        for i in range(dbn.num_factors):
            arity = len(dbn.parents(a, i))
            inner: tuple[slice, ...] = (slice(0, k),) * arity
            visits = np.zeros((k + 1,) * arity, dtype=np.int64)
            visits[inner] = dbn.counts(a, i).reshape((k,) * arity)
            tensor = dbn.tensor(a, i)
            keep = (tensor >= least) & (visits[inner] > 0)[..., None]
            table = np.zeros((k + 1,) * (arity + 1))
            table[..., k] = 1.0
            table[..., :k][inner] = np.where(keep, tensor, 0.0)
            # the sum of what is dropped, not 1 less what is kept: rounding must not lead anywhere
            table[..., k][inner] = np.where(keep, 0.0, tensor).sum(axis=-1)
            tables[-1].append(table.reshape(-1, k + 1))
            counts[-1].append(visits.reshape(-1))
    meanings = [[*texts, ELSEWHERE] for texts in dbn.value_meanings]
    part = TwoSliceDBN.from_tables(
        tables,
        dbn.parents_now,
        dbn.parents_next,
        action_names=dbn.action_names,
        factor_names=dbn.factor_names,
        order=dbn.order,
        counts=counts,
        initial=np.column_stack([dbn.initial, np.zeros(dbn.num_factors)]),
        value_meanings=meanings,
        provenance={**dbn.provenance, "known_part": {"least": least}},
    )
    return replace(part, tables=dict(dbn.tables))
