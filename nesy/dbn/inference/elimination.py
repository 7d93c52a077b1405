"""Exact one-step marginals planned once per model: which sums, in which order, over which flat arrays.

    P(S') for sets S' of next factors and of the present ones that they share, by forward recursion: with X the last
    factor of S' in `order`,
        P(S' + X) = sum over parents(X) not in S' of  P(S' + parents(X)) P(X | parents(X))
    where present factors that no other factor in question depends on come in as their belief, and are summed out of
    X's table beforehand where that is less work. Factors that nothing in question depends on never appear. Sets
    asked for several times are computed once, smaller ones from larger ones.

The plan is plain integers, run for every belief by one compiled kernel (nesy.dbn.inference.factored).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nesy.dbn.inference.reachable import ancestors
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MAX_WORKSPACE = 1 << 24


class Programs(NamedTuple):
    """The planned sums of all actions; a named tuple, so numba takes it as an argument.

    An operation is `out[outer, k] = sum over summed of joint[...] prod belief[...] table[..., k]`. Variables v < N are
    factors of slice t, v >= N factor v - N of slice t+1; `memory` of one belief holds first the belief [N, K], then
    the result [N, K], then K ones, then intermediate tables.
    """

    first: np.ndarray
    """int64 [A + 1]: first operation of each action."""
    target: np.ndarray
    """int64 [O]: the factor of slice t+1 that `k` is about."""
    num_outer: np.ndarray
    """int64 [O]."""
    num_loops: np.ndarray
    """int64 [O]: outer and summed variables."""
    variables: np.ndarray
    """int64 [O, V]: outer ones first."""
    shared: np.ndarray
    """bool [O]: the table is one of the model's rather than an intermediate one."""
    table: np.ndarray
    """int64 [O]: where it starts."""
    table_strides: np.ndarray
    """int64 [O, V]."""
    joint: np.ndarray
    """int64 [O]: where the joint distribution starts; the ones where there is none."""
    joint_strides: np.ndarray
    """int64 [O, V]."""
    out: np.ndarray
    """int64 [O]."""
    out_strides: np.ndarray
    """int64 [O, V]."""
    beliefs: np.ndarray
    """int64 [O, V]: where the weights of a variable's values stand; the ones where it has none."""
    mixes: np.ndarray
    """bool [O]: the rows of one of the model's tables, mixed by the beliefs of its parents in slice t."""
    memory: int
    """Entries of one belief's memory."""


@dataclass(frozen=True)
class _Tensor:
    """A table in the model's memory (`shared`) or in that of one belief; its last axis has stride 1."""

    scope: tuple[int, ...]
    shared: bool
    offset: int
    num_values: int

    def stride(self, variable: int) -> int:
        """0 where the table does not have the variable."""
        if variable not in self.scope:
            return 0
        return int(self.num_values ** (len(self.scope) - 1 - self.scope.index(variable)))


@dataclass(frozen=True)
class _Operation:
    outer: tuple[int, ...]
    summed: tuple[int, ...]
    weighted: frozenset[int]
    table: _Tensor
    joint: _Tensor | None
    out: _Tensor


@dataclass(frozen=True)
class _Step:
    """How one set is computed: from a larger one with the same last factor, or from the last factor's table."""

    larger: frozenset[int] | None
    joint: frozenset[int] | None = None
    private: frozenset[int] = frozenset()


class _Planner:
    """Plans the sums of one action."""

    def __init__(self, dbn: TwoSliceDBN, action: int, memory: int) -> None:
        self.dbn, self.action, self.memory = dbn, action, memory
        self.n, self.k = dbn.num_factors, dbn.num_values
        self.rank = {self.n + i: place for place, i in enumerate(dbn.order)}
        self.operations: list[_Operation] = []
        self._made: dict[frozenset[int], _Tensor] = {}
        self._reduced: dict[tuple[int, frozenset[int]], _Tensor] = {}

    def plan(self) -> None:
        """Plan the marginals of all factors; the operations stand in `operations`."""
        wanted: dict[int, set[frozenset[int]]] = {self.n + i: {frozenset([self.n + i])} for i in range(self.n)}
        steps: dict[frozenset[int], _Step] = {}
        chosen: list[list[frozenset[int]]] = []
        # what a later factor needs of earlier ones is known once the later one has been looked at
        for i in reversed(self.dbn.order):
            asked = sorted(wanted[self.n + i], key=lambda s: (-len(s), sorted(s)))
            for place, scope in enumerate(asked):
                step = self._step(self.n + i, scope, asked[:place])
                steps[scope] = step
                if step.joint is not None:
                    wanted[self._last(step.joint)].add(step.joint)
            chosen.append(asked)
        for asked in reversed(chosen):
            for scope in asked:
                self._emit(scope, steps[scope])

    def _last(self, scope: frozenset[int]) -> int:
        return max((v for v in scope if v >= self.n), key=self.rank.__getitem__)

    def _step(self, x: int, scope: frozenset[int], larger: list[frozenset[int]]) -> _Step:
        """The cheaper way to one set; `larger` ones with the same last factor come before it."""
        parents = {where * self.n + p for where, p in self.dbn.parents(self.action, x - self.n)}
        needed = (scope - {x}) | parents
        joint = {v for v in needed if v >= self.n}
        if joint:
            below = ancestors(self.dbn, self.action, tuple(v - self.n for v in joint))
            joint |= needed & {p for i in below for p in self.dbn.parents_now[self.action][i]}
        private = parents - joint - scope
        within = len(needed) + 1
        if private and needed - parents:
            within = max(len(parents), len(needed - private)) + 1
        else:
            private = set()
        fitting = [s for s in larger if s > scope]
        nearest = min(fitting, key=len, default=None)
        if nearest is not None and len(nearest) < within:
            return _Step(nearest)
        return _Step(None, frozenset(joint) if joint else None, frozenset(private))

    def _emit(self, scope: frozenset[int], step: _Step) -> None:
        x = self._last(scope)
        kept = tuple(sorted(scope - {x}))
        if step.larger is not None:
            table, joint = self._made[step.larger], None
            summed, weighted = step.larger - scope, frozenset[int]()
        else:
            table = self._table(x, step.private)
            joint = None if step.joint is None else self._made[step.joint]
            parents = set(table.scope) - {x}
            summed = (frozenset(parents) | (step.joint or frozenset())) - scope
            weighted = (frozenset(parents) | frozenset(kept)) - (step.joint or frozenset())
        out = _Tensor((x,), False, x * self.k, self.k) if not kept else self._new((*kept, x))
        self._made[scope] = out
        self.operations.append(_Operation(kept, self._in_order(table, summed), weighted, table, joint, out))

    def _table(self, x: int, private: frozenset[int]) -> _Tensor:
        """The conditional table of a factor, with its private parents summed out."""
        axes = tuple(where * self.n + p for where, p in self.dbn.parents(self.action, x - self.n))
        whole = _Tensor((*axes, x), True, int(self.dbn.offsets[self.action, x - self.n]) * self.k, self.k)
        if not private:
            return whole
        key = (x, private)
        if key not in self._reduced:
            kept = tuple(v for v in axes if v not in private)
            out = self._new((*kept, x))
            self.operations.append(_Operation(kept, self._in_order(whole, private), private, whole, None, out))
            self._reduced[key] = out
        return self._reduced[key]

    def _new(self, scope: tuple[int, ...]) -> _Tensor:
        out = _Tensor(scope, False, self.memory, self.k)
        self.memory += self.k ** len(scope)
        if self.memory > MAX_WORKSPACE:
            raise UserError("this model is too densely connected for exact marginals; sample instead")
        return out

    @staticmethod
    def _in_order(table: _Tensor, variables: frozenset[int]) -> tuple[int, ...]:
        """Summed variables: those of the table last and in its order, so that neighbours are read one after another."""
        return tuple(sorted(variables - set(table.scope))) + tuple(v for v in table.scope if v in variables)


def plan_updates(dbn: TwoSliceDBN) -> Programs:
    """Plan the marginals of every factor under every action.

    Raises:
        UserError: the model is too densely connected.
    """
    n, k = dbn.num_factors, dbn.num_values
    ones = 2 * n * k
    first, operations, memory = [0], list[_Operation](), ones + k
    for action in range(dbn.num_actions):
        planner = _Planner(dbn, action, ones + k)
        planner.plan()
        operations += planner.operations
        first.append(len(operations))
        memory = max(memory, planner.memory)
    number = len(operations)
    width = max(1, max(len(o.outer) + len(o.summed) for o in operations))

    def filled(value: int = 0) -> np.ndarray:
        return np.full((number, width), value, dtype=np.int64)

    programs = Programs(
        first=np.array(first, dtype=np.int64),
        target=np.array([o.out.scope[-1] - n for o in operations], dtype=np.int64),
        num_outer=np.array([len(o.outer) for o in operations], dtype=np.int64),
        num_loops=np.array([len(o.outer) + len(o.summed) for o in operations], dtype=np.int64),
        variables=filled(),
        shared=np.array([o.table.shared for o in operations]),
        table=np.array([o.table.offset for o in operations], dtype=np.int64),
        table_strides=filled(),
        joint=np.array([ones if o.joint is None else o.joint.offset for o in operations], dtype=np.int64),
        joint_strides=filled(),
        out=np.array([o.out.offset for o in operations], dtype=np.int64),
        out_strides=filled(),
        beliefs=filled(ones),
        mixes=np.array(
            [o.table.shared and o.joint is None and o.out.offset == o.out.scope[-1] * k for o in operations]
        ),
        memory=memory,
    )
    for row, o in enumerate(operations):
        for place, v in enumerate((*o.outer, *o.summed)):
            programs.variables[row, place] = v
            programs.table_strides[row, place] = o.table.stride(v)
            programs.joint_strides[row, place] = 0 if o.joint is None else o.joint.stride(v)
            programs.out_strides[row, place] = o.out.stride(v) if place < len(o.outer) else 0
            if v in o.weighted:
                programs.beliefs[row, place] = v * k
    return programs
