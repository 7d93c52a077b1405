"""Distributions that ask about one variable before all else: P(target | first, parents) as a tree of trees.

A decision tree asks what tells its examples apart, and where two things always went together one question does for
both. For a planner that is a trap when one of them is an action: "the goal is ahead of the person" foretold success
for steps in which the person stays, as no such step was logged, and the search went for them. What was seen of one
action says nothing of another; learned apart for each, a table cannot confuse them.
"""

from __future__ import annotations

import numpy as np

from planners.models.tables import DecisionTable, Parents, learn_distribution


def learn_by(
    first: int, name: str, variables: np.ndarray, parents: Parents, target: np.ndarray, num_classes: int
) -> DecisionTable:
    """Learn P(target | variable `first`, parents), apart for every value of `first`.

    Args:
        first: slot of the variable that is asked about first; a value that was not seen counts as the greatest one.
        name: of that variable.
        variables: int [n, slots], non-negative small integers.
        parents: which slots may be asked about after it.
        target: int [n] in 0..num_classes-1.
        num_classes: number of classes.
    """
    values = np.unique(variables[:, first])
    parts = []
    for value in values:
        rows = variables[:, first] == value
        parts.append(learn_distribution(variables[rows], parents, target[rows], num_classes))
    table = parts.pop()
    for value, part in zip(values[-2::-1], parts[::-1], strict=True):
        table = _either(first, name, int(value), part, table)
    return table


def _either(slot: int, name: str, value: int, yes: DecisionTable, no: DecisionTable) -> DecisionTable:
    """The table `yes` where the variable at `slot` is `value`, else the table `no`."""
    after_yes = 1 + len(yes.slot)
    return DecisionTable(
        slot=np.concatenate([[slot], yes.slot, no.slot]).astype(np.int32),
        value=np.concatenate([[value], yes.value, no.value]).astype(np.int32),
        ordered=np.concatenate([[False], yes.ordered, no.ordered]),
        yes=np.concatenate([[1], _moved(yes.slot, yes.yes, 1), _moved(no.slot, no.yes, after_yes)]).astype(np.int32),
        no=np.concatenate([[after_yes], _moved(yes.slot, yes.no, 1), _moved(no.slot, no.no, after_yes)]).astype(
            np.int32
        ),
        moments=np.concatenate([[yes.moments[0] + no.moments[0]], yes.moments, no.moments]),
        kind=yes.kind,
        names={**yes.names, **no.names, slot: name},
    )


def _moved(slot: np.ndarray, child: np.ndarray, by: int) -> np.ndarray:
    """Children of asking nodes, `by` further on; what stands at rows is left as it is."""
    return np.where(slot >= 0, child + by, child)
