"""The two-slice dynamic Bayesian network (2DBN) as plain data.

State   a code: N factors X_0 ... X_{N-1} with K values each.
Action  a: for every (a, i) the parents of X'_i, factors of slice t (`parents_now`) and, where that pays,
        earlier factors of slice t+1 (`parents_next`, earlier in `order`), and a conditional table.
Model   T(x' | x, a) = prod_i P(x'_i | x[parents_now], x'[parents_next], a).

A table has one row per combination of parent values, in mixed radix: the first parent is the most
significant digit, parents of slice t come before those of slice t+1.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.checked_arrays import integers
from nesy.dbn.checked_tables import check_rows, flat_tables
from nesy.dbn.rows import code_type
from nesy.dbn.step_tables import NAMES, StepTable
from nesy.errors import UserError

if TYPE_CHECKING:
    import networkx

MAX_ROWS = 1 << 25

Parents = tuple[tuple[tuple[int, ...], ...], ...]


@dataclass(frozen=True, eq=False)
class TwoSliceDBN:
    """A 2DBN. Build one with `from_tables`; all arrays are shared and must not be written to."""

    factor_names: tuple[str, ...]
    """N names."""
    num_values: int
    """K, the same for every factor."""
    action_names: tuple[str, ...]
    """A names."""
    parents_now: Parents
    """[a][i]: factors of slice t that X'_i depends on under action a."""
    parents_next: Parents
    """[a][i]: factors of slice t+1 that X'_i depends on under action a; each comes earlier in `order`."""
    order: tuple[int, ...]
    """The order in which the factors of slice t+1 are decided."""
    probabilities: np.ndarray
    """float64 [rows, K]: the rows of all tables, one after the other (see `offsets`)."""
    row_counts: np.ndarray
    """int64 [rows]: how often a row was met in experience; 0 marks a row that the data say nothing about."""
    initial: np.ndarray
    """float64 [N, K]: marginal distribution of each factor at the start of an episode."""
    value_meanings: tuple[tuple[str, ...], ...] = ()
    """[N][K]: what a value means, as text; empty where unknown."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the model comes from: run, seed, hash of the network, ... (JSON values)."""
    tables: dict[str, np.ndarray] = field(default_factory=dict)
    """What experience says besides: `codes` uint8 [C, N] met, `taken` int64 [A], `changed` int64 [A, N]."""
    step_tables: dict[str, StepTable] = field(default_factory=dict)
    """Observation model, reward and termination (see nesy.dbn.step_tables), as far as they are known."""

    # ---------------------------------------------------------------- building
    @classmethod
    def from_tables(
        cls,
        cpts: Sequence[Sequence[np.ndarray]],
        parents_now: Sequence[Sequence[Sequence[int]]],
        parents_next: Sequence[Sequence[Sequence[int]]] | None = None,
        *,
        action_names: Sequence[str] | None = None,
        factor_names: Sequence[str] | None = None,
        order: Sequence[int] | None = None,
        counts: Sequence[Sequence[np.ndarray]] | None = None,
        initial: np.ndarray | None = None,
        value_meanings: Sequence[Sequence[str]] = (),
        provenance: dict[str, Any] | None = None,
    ) -> TwoSliceDBN:
        """Build a model from its tables.

        Args:
            cpts: [A][N] arrays float64 [rows, K], rows sum to 1; K is the same for all.
            parents_now: [A][N] parents in slice t.
            parents_next: [A][N] parents in slice t+1; none by default.
            action_names: A names; `a0`, `a1`, ... by default.
            factor_names: N names; `X0`, `X1`, ... by default.
            order: the order of the factors within slice t+1; by default one that suits `parents_next`.
            counts: [A][N] arrays [rows]: visits; zero by default.
            initial: float64 [N, K]; uniform by default.
            value_meanings: [N][K] texts.
            provenance: JSON values.

        Raises:
            UserError: the parts do not fit together.
        """
        num_actions, num_factors = len(cpts), len(cpts[0]) if cpts else 0
        if not num_actions or not num_factors:
            raise UserError("a 2DBN needs at least one action and one factor")
        flat, num_values = flat_tables(cpts)
        now = tuple(tuple(tuple(int(p) for p in ps) for ps in per_action) for per_action in parents_now)
        nxt = (
            tuple(tuple(tuple(int(p) for p in ps) for ps in per_action) for per_action in parents_next)
            if parents_next is not None
            else tuple(((),) * num_factors for _ in range(num_actions))
        )
        check_rows(cpts, "rows", now, nxt, num_values)
        visits = np.zeros(len(flat), dtype=np.int64)
        if counts is not None:
            check_rows(counts, "counts", now, nxt, num_values)
            visits = np.concatenate([integers(c, "counts", (None,)).astype(np.int64) for cs in counts for c in cs])
        for what, names, number in (("factor", factor_names, num_factors), ("action", action_names, num_actions)):
            if names and len(names) != number:
                raise UserError(f"{number} {what}s need as many {what}_names, found {len(names)}: {', '.join(names)}")
        return cls(
            factor_names=tuple(factor_names or (f"X{i}" for i in range(num_factors))),
            num_values=num_values,
            action_names=tuple(action_names or (f"a{a}" for a in range(num_actions))),
            parents_now=now,
            parents_next=nxt,
            order=tuple(int(i) for i in order) if order is not None else topological_order(nxt, num_factors),
            probabilities=flat,
            row_counts=visits,
            initial=(
                np.full((num_factors, num_values), 1.0 / num_values)
                if initial is None
                else np.asarray(initial, dtype=np.float64)
            ),
            value_meanings=tuple(tuple(str(m) for m in ms) for ms in value_meanings),
            provenance=dict(provenance or {}),
        )

    def __post_init__(self) -> None:
        self._check_structure()
        sizes = np.array([[self.num_rows(a, i) for i in range(self.num_factors)] for a in range(self.num_actions)])
        ends = np.cumsum(sizes.reshape(-1))
        object.__setattr__(self, "offsets", (ends - sizes.reshape(-1)).reshape(sizes.shape).astype(np.int64))
        self._check_tables(int(ends[-1]))
        for name, table in self.step_tables.items():
            if name not in NAMES:
                raise UserError(f"no step table is called '{name}'; they are {', '.join(NAMES)}")
            table.check(self.num_factors, self.num_values, self.num_actions)

    offsets: np.ndarray = field(init=False, repr=False)
    """int64 [A, N]: first row of each table in `probabilities`."""

    def _check_structure(self) -> None:
        n, k = self.num_factors, self.num_values
        if not n or not self.num_actions or k < 1:
            raise UserError("a 2DBN needs at least one factor, one value and one action")
        for name in (*self.factor_names, *self.action_names):
            if not isinstance(name, str) or re.search("[\ud800-\udfff]", name):
                raise UserError(f"{name!r}: a factor or action has text as its name (without lone surrogates)")
        if len(set(self.factor_names)) != n or len(set(self.action_names)) != self.num_actions:
            raise UserError("the names of factors and of actions must differ from each other")
        if sorted(self.order) != list(range(n)):
            raise UserError(f"order must hold each of the {n} factors once, found {self.order}")
        rank = {factor: position for position, factor in enumerate(self.order)}
        for name, parents in (("parents_now", self.parents_now), ("parents_next", self.parents_next)):
            if len(parents) != self.num_actions or any(len(per_action) != n for per_action in parents):
                raise UserError(f"{name} must have one entry per action and factor")
            for a, per_action in enumerate(parents):
                for i, ps in enumerate(per_action):
                    if len(set(ps)) != len(ps) or not all(0 <= p < n for p in ps):
                        raise UserError(f"{name} of factor {i} under action {a}: {ps} are not distinct factors")
                    if name == "parents_next" and any(rank[p] >= rank[i] for p in ps):
                        raise UserError(f"parents_next of factor {i} under action {a} do not come earlier in order")
        if any(k ** len(self.parents(a, i)) > MAX_ROWS for a in range(self.num_actions) for i in range(n)):
            raise UserError(f"a table of this model would have more than {MAX_ROWS} rows; use fewer parents")
        if self.value_meanings and (len(self.value_meanings) != n or any(len(m) != k for m in self.value_meanings)):
            raise UserError("value_meanings must have one text per factor and value")

    def _check_tables(self, rows: int) -> None:
        if self.probabilities.shape != (rows, self.num_values) or self.probabilities.dtype != np.float64:
            raise UserError(
                f"the tables must be float64 [{rows}, {self.num_values}] for these parents, "
                f"found {self.probabilities.dtype} {list(self.probabilities.shape)}"
            )
        if self.row_counts.shape != (rows,) or (self.row_counts < 0).any():
            raise UserError(f"the counts must be {rows} numbers >= 0")
        if self.initial.shape != (self.num_factors, self.num_values):
            raise UserError(f"initial must have the shape [{self.num_factors}, {self.num_values}]")
        for what, table in (("table row", self.probabilities), ("initial distribution", self.initial)):
            lowest = table.min()
            # written so that NaN fails too
            if not (lowest >= 0.0 and np.abs(table.sum(axis=1) - 1.0).max() <= 1e-6):
                raise UserError(f"a {what} is no probability distribution (negative, not finite, or sum not 1)")

    # ---------------------------------------------------------------- reading
    @property
    def num_factors(self) -> int:
        """N."""
        return len(self.factor_names)

    @property
    def num_actions(self) -> int:
        """A."""
        return len(self.action_names)

    @property
    def code_type(self) -> np.dtype:
        """The type of codes: the narrowest that holds every value, uint8 up to K = 256."""
        return code_type(self.num_values)

    def parents(self, action: int, factor: int) -> tuple[tuple[int, int], ...]:
        """The parents of a factor as (slice 0 or 1, factor), in the order of the table's digits."""
        return tuple((0, p) for p in self.parents_now[action][factor]) + tuple(
            (1, p) for p in self.parents_next[action][factor]
        )

    def num_rows(self, action: int, factor: int) -> int:
        """Rows of one table."""
        return int(self.num_values ** len(self.parents(action, factor)))

    def cpt(self, action: int, factor: int) -> np.ndarray:
        """One conditional table: float64 [rows, K]."""
        start = self.offsets[action, factor]
        return self.probabilities[start : start + self.num_rows(action, factor)]

    def counts(self, action: int, factor: int) -> np.ndarray:
        """How often each row of one table was met in experience: int64 [rows]."""
        start = self.offsets[action, factor]
        return self.row_counts[start : start + self.num_rows(action, factor)]

    def tensor(self, action: int, factor: int) -> np.ndarray:
        """One table with an axis per parent and the factor's own last: float64 [K, ..., K]."""
        return self.cpt(action, factor).reshape((self.num_values,) * (len(self.parents(action, factor)) + 1))

    def rows(self, action: int, factor: int, codes: np.ndarray, next_codes: np.ndarray) -> np.ndarray:
        """Row of one table that each transition uses.

        Args:
            action: the action.
            factor: the factor.
            codes: integers [..., N], slice t.
            next_codes: integers [..., N], slice t+1; only the parents of slice t+1 are read.

        Returns:
            int64 [...].
        """
        row = np.zeros(np.shape(codes)[:-1], dtype=np.int64)
        for where, parent in self.parents(action, factor):
            row = row * self.num_values + (codes, next_codes)[where][..., parent]
        return row

    # ---------------------------------------------------------------- inference
    def log_prob(self, code: np.ndarray, action: int | str | np.ndarray, next_code: np.ndarray) -> np.ndarray:
        """Log-probability T(x' | x, a) in nats, of one transition or many.

        Args:
            code: integers [..., N].
            action: integer or integers [...].
            next_code: integers [..., N].

        Returns:
            float64 [...]; -inf where the transition is impossible.
        """
        codes, next_codes = np.broadcast_arrays(self._codes(code), self._codes(next_code))
        actions = np.broadcast_to(self.action_indices(action), codes.shape[:-1])
        result = np.zeros(codes.shape[:-1])
        for a in np.unique(actions):
            chosen = actions == a
            now, later = codes[chosen], next_codes[chosen]
            total = np.zeros(len(now))
            with np.errstate(divide="ignore"):
                for i in range(self.num_factors):
                    total += np.log(self.cpt(a, i)[self.rows(a, i, now, later), later[:, i]])
            result[chosen] = total
        return result

    def sample(self, code: np.ndarray, action: int | str | np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw x' ~ T(. | x, a), for one code or many.

        Args:
            code: integers [..., N].
            action: integer or integers [...].
            rng: source of randomness; one uniform number per factor is drawn.

        Returns:
            [..., N], of `code_type`.
        """
        codes = self._codes(code)
        actions = np.broadcast_to(self.action_indices(action), codes.shape[:-1])
        uniforms = rng.random(codes.shape)
        result = np.zeros(codes.shape, dtype=self.code_type)
        for a in np.unique(actions):
            chosen = actions == a
            now, draws = codes[chosen], uniforms[chosen]
            later = np.zeros(now.shape, dtype=np.int64)
            for i in self.order:
                cumulative = np.cumsum(self.cpt(a, i)[self.rows(a, i, now, later)], axis=1)
                # scaled by the row's sum, so that rounding never yields the value K
                later[:, i] = (draws[:, i, None] * cumulative[:, -1:] >= cumulative).sum(axis=1)
            result[chosen] = later
        return result

    def predict(self, belief: np.ndarray, action: int | str) -> np.ndarray:
        """Exact marginals of the next factors, the factors being independent now.

        Args:
            belief: [N, K], rows sum to 1.
            action: the action, by number or name.

        Returns:
            float64 [N, K].
        """
        from nesy.dbn.inference.exact import predict

        return predict(self, belief, self.action_index(action))

    def filter(self, belief: np.ndarray, action: int | str, likelihood: np.ndarray) -> np.ndarray:
        """Exact posterior marginals after an action and an observation (see nesy.dbn.inference.exact.update)."""
        from nesy.dbn.inference.exact import update

        return update(self, belief, self.action_index(action), likelihood)

    def to_networkx(self, action: int | None = None) -> networkx.MultiDiGraph:
        """The graph: nodes `X0` (slice t) and `X0'` (slice t+1); an edge per action and parent.

        Every edge has the attributes `action` (its name) and `strength` (how far the parent's value changes the
        child's distribution on average, in [0, 1]; see nesy.dbn.graph.arc_strength).
        """
        from nesy.dbn.graph import to_networkx

        return to_networkx(self, action)

    # ---------------------------------------------------------------- files
    def save(self, path: Path | str) -> None:
        """Write model.json and tables.npz into the folder `path`."""
        from nesy.dbn.model_files import save

        save(self, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> TwoSliceDBN:
        """Read a model from the folder `path`.

        Raises:
            UserError: a file is missing, damaged, or does not hold a 2DBN.
        """
        from nesy.dbn.model_files import load

        return load(Path(path), cls)

    # ---------------------------------------------------------------- checks
    def _codes(self, code: np.ndarray) -> np.ndarray:
        codes = np.asarray(code)
        if codes.shape[-1:] != (self.num_factors,) or not np.issubdtype(codes.dtype, np.integer):
            raise UserError(f"a code has {self.num_factors} integers, found {codes.dtype} {list(codes.shape)}")
        if codes.size and (codes.min() < 0 or codes.max() >= self.num_values):
            raise UserError(f"a code's values lie in 0..{self.num_values - 1}")
        return codes.astype(np.int64)

    def action_indices(self, actions: int | str | Sequence[int | str] | np.ndarray) -> np.ndarray:
        """Actions as int64 [...], given as numbers or by their names.

        Raises:
            UserError: no such action.
        """
        given = np.asarray(actions)
        if given.dtype.kind == "U":
            places = {name: a for a, name in enumerate(self.action_names)}
            given = np.array([places.get(str(name), -1) for name in given.reshape(-1)], np.int64).reshape(given.shape)
        if given.size and (given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= self.num_actions):
            known = ", ".join(self.action_names)
            raise UserError(f"an action lies in 0..{self.num_actions - 1} or is one of {known}; found {actions!r}")
        return given.astype(np.int64)

    def action_index(self, action: int | str) -> int:
        """One action as a number, given as that or by its name.

        Raises:
            UserError: no such action.
        """
        found = self.action_indices(action)
        if found.ndim:
            raise UserError(f"one action is needed, not {action!r}")
        return int(found)


def topological_order(parents_next: Parents, num_factors: int) -> tuple[int, ...]:
    """An order of the factors that suits the arcs within slice t+1 of every action.

    Raises:
        UserError: there is none.
    """
    waiting = {i: {p for per_action in parents_next for p in per_action[i]} for i in range(num_factors)}
    order: list[int] = []
    while waiting:
        ready = [i for i, ps in waiting.items() if not ps & waiting.keys()]
        if not ready:
            raise UserError(f"the arcs within slice t+1 form a cycle through the factors {sorted(waiting)}")
        order += ready
        for i in ready:
            del waiting[i]
    return tuple(order)
