"""Tables beside the transitions of a 2DBN: observation model, reward, termination.

    observation   P(cell | x'), one target per cell of a view, the same under every action
    reward        E[r | x, a, x']
    termination   P(the episode ends | x, a, x')

Every target has its own parents, factors of slice t and of slice t+1, and a table laid out as those of the factors:
one row per combination of the parents' values in mixed radix, the first parent most significant, slice t first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nesy.dbn.rows import distinct_rows, expanded_rows, scattered_counts
from nesy.errors import UserError

NAMES = ("observation", "reward", "termination")
"""The tables that a model may have."""
MAX_ENTRIES = 1 << 26

Parents = tuple[tuple[tuple[int, ...], ...], ...]


@dataclass(frozen=True, eq=False)
class StepTable:
    """A distribution or a mean for each of T targets, given values of a step (x, a, x')."""

    targets: tuple[str, ...]
    """T names."""
    outcomes: tuple[str, ...]
    """Names of the M outcomes of a distribution; empty for a mean (M = 1)."""
    num_values: int
    """K of the factors."""
    parents_now: Parents
    """[a][target]: factors of slice t; a single entry a = 0 stands for every action."""
    parents_next: Parents
    """[a][target]: factors of slice t+1."""
    values: np.ndarray
    """float64 [rows, M]: the rows of all tables, one after the other."""
    row_counts: np.ndarray
    """int64 [rows]: how often a row was met; 0 marks a row that the data say nothing about."""
    offsets: np.ndarray = field(init=False, repr=False)
    """int64 [A, T]: first row of each table."""

    def __post_init__(self) -> None:
        groups, number = len(self.parents_now), len(self.targets)
        if not groups or not number or len(self.parents_next) != groups:
            raise UserError("a step table needs targets, and parents for one or every action")
        for parents in (self.parents_now, self.parents_next):
            if any(len(per_action) != number for per_action in parents):
                raise UserError("a step table has parents for each of its targets")
        arity = [[len(self.parents(a, t)) for t in range(number)] for a in range(groups)]
        entries = sum(self.num_values**n for per_action in arity for n in per_action) * self.width
        if entries > MAX_ENTRIES:
            raise UserError(f"a step table would have more than {MAX_ENTRIES} entries; use fewer parents")
        sizes = np.array([[self.num_values**n for n in per_action] for per_action in arity], dtype=np.int64)
        ends = np.cumsum(sizes.reshape(-1))
        object.__setattr__(self, "offsets", (ends - sizes.reshape(-1)).reshape(sizes.shape))
        if self.values.shape != (int(ends[-1]), self.width) or self.values.dtype != np.float64:
            raise UserError(f"a step table of these parents must be float64 [{int(ends[-1])}, {self.width}]")
        if self.row_counts.shape != (int(ends[-1]),) or (self.row_counts < 0).any():
            raise UserError("a step table has one count >= 0 per row")
        if not np.isfinite(self.values).all():
            raise UserError("a step table holds a number that is not finite")
        if self.outcomes and not (self.values.min() >= 0.0 and np.abs(self.values.sum(axis=1) - 1.0).max() <= 1e-6):
            raise UserError("a row of a step table is no probability distribution (negative, or sum not 1)")

    @property
    def width(self) -> int:
        """M, numbers in a row."""
        return len(self.outcomes) or 1

    def group(self, action: int) -> int:
        """Which entry of the parents belongs to an action."""
        return action if len(self.parents_now) > 1 else 0

    def parents(self, action: int, target: int) -> tuple[tuple[int, int], ...]:
        """Parents of a target as (slice 0 or 1, factor), in the order of the table's digits."""
        a = self.group(action)
        return tuple((0, p) for p in self.parents_now[a][target]) + tuple((1, p) for p in self.parents_next[a][target])

    def table(self, action: int, target: int) -> np.ndarray:
        """One table: float64 [rows, M]."""
        return self.values[self._rows(action, target)]

    def counts(self, action: int, target: int) -> np.ndarray:
        """Counts behind the rows of one table: int64 [rows]."""
        return self.row_counts[self._rows(action, target)]

    def tensor(self, action: int, target: int) -> np.ndarray:
        """One table with an axis per parent and the outcomes last: float64 [K, ..., M]."""
        shape = (self.num_values,) * len(self.parents(action, target))
        return self.table(action, target).reshape(*shape, self.width)

    def _rows(self, action: int, target: int) -> slice:
        start = int(self.offsets[self.group(action), target])
        return slice(start, start + self.num_values ** len(self.parents(action, target)))

    def look_up(self, codes: np.ndarray, actions: np.ndarray, next_codes: np.ndarray) -> np.ndarray:
        """The rows of some steps.

        Args:
            codes: integers [n, N], slice t; read only where a target has parents there.
            actions: integers [n].
            next_codes: integers [n, N], slice t+1.

        Returns:
            float64 [n, T, M].
        """
        actions = np.asarray(actions)
        result = np.empty((len(actions), len(self.targets), self.width))
        for a in np.unique(actions):
            chosen = actions == a
            both = (np.asarray(codes)[chosen], np.asarray(next_codes)[chosen])
            for t in range(len(self.targets)):
                row = np.zeros(int(chosen.sum()), dtype=np.int64)
                for where, p in self.parents(int(a), t):
                    row = row * self.num_values + both[where][:, p]
                result[chosen, t] = self.table(int(a), t)[row]
        return result

    # ---------------------------------------------------------------- files
    def document(self) -> dict[str, Any]:
        """Everything but the numbers, as JSON values."""
        return {
            "targets": list(self.targets),
            "outcomes": list(self.outcomes),
            "parents_now": [[list(ps) for ps in per_action] for per_action in self.parents_now],
            "parents_next": [[list(ps) for ps in per_action] for per_action in self.parents_next],
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The numbers, with equal rows kept once."""
        distinct, index = distinct_rows(self.values)
        met = np.flatnonzero(self.row_counts)
        return {"rows": distinct, "index": index, "met": met, "counts": self.row_counts[met]}

    @classmethod
    def restore(cls, document: dict[str, Any], arrays: dict[str, np.ndarray], model: tuple[int, int, int]) -> StepTable:
        """What `document` and `arrays` took apart.

        Args:
            document: see `document`.
            arrays: see `arrays`.
            model: numbers of factors, values and actions of the model it belongs to.

        Raises:
            UserError: it does not fit the model.
            KeyError, TypeError, ValueError, IndexError: it is no step table.
        """
        factors, num_values, actions = model
        table = cls(
            targets=tuple(str(name) for name in document["targets"]),
            outcomes=tuple(str(name) for name in document["outcomes"]),
            num_values=num_values,
            parents_now=_parents(document["parents_now"]),
            parents_next=_parents(document["parents_next"]),
            values=expanded_rows(arrays["rows"], arrays["index"]),
            row_counts=scattered_counts(arrays["met"], arrays["counts"], len(arrays["index"])),
        )
        table.check(factors, num_values, actions)
        return table

    def plain(self) -> dict[str, Any]:
        """All of it as JSON values."""
        arrays = {k: {"dtype": array.dtype.str, "values": array.tolist()} for k, array in self.arrays().items()}
        return {"document": self.document(), "arrays": arrays}

    @classmethod
    def from_plain(cls, value: dict[str, Any], model: tuple[int, int, int]) -> StepTable:
        """What `plain` wrote; errors as `restore`."""
        arrays = {k: np.array(a["values"], dtype=np.dtype(str(a["dtype"]))) for k, a in value["arrays"].items()}
        return cls.restore(value["document"], arrays, model)

    def check(self, factors: int, num_values: int, actions: int) -> None:
        """Whether the table fits a model.

        Raises:
            UserError: it does not.
        """
        if self.num_values != num_values or len(self.parents_now) not in (1, actions):
            raise UserError("a step table belongs to a model with other values or actions")
        for parents in (self.parents_now, self.parents_next):
            for ps in (ps for per_action in parents for ps in per_action):
                if len(set(ps)) != len(ps) or not all(0 <= p < factors for p in ps):
                    raise UserError(f"a step table has the parents {ps}, which are not distinct factors")

    def same_as(self, other: StepTable) -> bool:
        """Whether two tables are equal bit for bit."""
        return (
            self.document() == other.document()
            and self.num_values == other.num_values
            and np.array_equal(self.values, other.values)
            and np.array_equal(self.row_counts, other.row_counts)
        )


def _parents(value: Any) -> Parents:
    return tuple(tuple(tuple(int(p) for p in ps) for ps in per_action) for per_action in value)
