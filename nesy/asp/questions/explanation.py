"""Why a step happens: the rows of the model behind it, as text and as a graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nesy.asp.finding import Edge, graph_of
from nesy.dbn.inference.exact import most_probable_next
from nesy.dbn.model import TwoSliceDBN

if TYPE_CHECKING:
    import networkx


@dataclass(frozen=True)
class Support:
    """The row that decides one factor."""

    factor: str
    value: int
    probability: float
    """Of the value in that row."""
    count: int
    """How often the row was met in experience; 0: the model guesses."""
    parents: tuple[tuple[str, int], ...]
    """(parent, value) pairs; a stroke marks slice t+1."""
    meaning: str
    """What the value means, where known."""


@dataclass(frozen=True)
class Explanation:
    """The rows behind one step."""

    action: str
    code: tuple[int, ...]
    next_code: tuple[int, ...]
    probability: float
    """Of the step: the product of the rows' probabilities."""
    supports: tuple[Support, ...]
    """One per factor, in the order in which the model decides them."""

    @property
    def text(self) -> str:
        """For people: what changes first, then what stays."""
        lines = [f"'{self.action}' leads from {self.code} to {self.next_code} with probability {self.probability:.4g}"]
        changed = [s for s, old in self._with_old() if s.value != old]
        for title, chosen in (("changes", changed), ("stays", [s for s in self.supports if s not in changed])):
            for s in chosen:
                given = ", ".join(f"{name} = {value}" for name, value in s.parents) or "nothing"
                met = f"met {s.count} times" if s.count else "never met: a guess"
                meaning = f"  [{s.meaning}]" if s.meaning else ""
                lines.append(
                    f"  {title}: {s.factor}' = {s.value} (probability {s.probability:.4g}) "
                    f"because of {given} ({met}){meaning}"
                )
        return "\n".join(lines)

    def _with_old(self) -> list[tuple[Support, int]]:
        old = dict(zip(self._names, self.code, strict=True))
        return [(s, old[s.factor]) for s in self.supports]

    _names: tuple[str, ...] = ()

    @property
    def support(self) -> list[Edge]:
        """The parents' values behind each value, as edges."""
        return [
            (f"{name} = {value}", f"{s.factor}' = {s.value}", f"{s.probability:.3g}, met {s.count}")
            for s in self.supports
            for name, value in s.parents
        ]

    def graph(self) -> networkx.DiGraph:
        """Nodes `X1 = 3` and `X1' = 3`; edges from the parents' values to the value they decide."""
        graph = graph_of(self.support)
        graph.add_nodes_from(f"{s.factor}' = {s.value}" for s in self.supports)
        return graph


def explain_step(dbn: TwoSliceDBN, code: np.ndarray, action: int, next_code: np.ndarray | None = None) -> Explanation:
    """The rows behind a step.

    Args:
        dbn: the model.
        code: integers [N].
        action: the action.
        next_code: integers [N]; the most probable next code by default. A factor given as -1 is left open and
            takes its most probable value.

    Raises:
        UserError: a code or action of another model.
    """
    now = dbn._codes(code)
    action = dbn.action_index(action)
    later = np.array(
        most_probable_next(dbn, now[None], action)[0][0] if next_code is None else next_code, dtype=np.int64
    )
    dbn._codes(np.maximum(later, 0))
    supports = []
    probability = 1.0
    for i in dbn.order:
        row_number = int(dbn.rows(action, i, now, later))
        row = dbn.cpt(action, i)[row_number]
        if later[i] < 0:
            later[i] = int(row.argmax())
        probability *= float(row[later[i]])
        parents = tuple(
            (dbn.factor_names[p] + ("'" if where else ""), int((now, later)[where][p]))
            for where, p in dbn.parents(action, i)
        )
        meaning = dbn.value_meanings[i][later[i]] if dbn.value_meanings else ""
        count = int(dbn.counts(action, i)[row_number])
        supports.append(Support(dbn.factor_names[i], int(later[i]), float(row[later[i]]), count, parents, meaning))
    return Explanation(
        dbn.action_names[action],
        tuple(int(v) for v in now),
        tuple(int(v) for v in later),
        probability,
        tuple(supports),
        dbn.factor_names,
    )
