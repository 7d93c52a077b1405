"""Variable elimination planned once per model: which sums, in which order, over which flat arrays.

The plan is plain integers, run for every belief by one compiled kernel (nesy.dbn.factored).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nesy.dbn.inference import ancestors
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MAX_WORKSPACE = 1 << 24


@dataclass(frozen=True)
class _Tensor:
    """A table in one of the kernel's two memories."""

    scope: tuple[int, ...]
    shared: bool
    """In the model's tables rather than in the memory of one belief."""
    offset: int
    strides: tuple[int, ...]


class Programs(NamedTuple):
    """The planned sums of all actions; a named tuple, so numba takes it as an argument.

    An operation sums a product of tables over some variables: `acc[k] += prod_j table_j[..., k]`. Its variables
    are ordered: those of the result first (`num_outer`), then those summed out; `k` is the inner variable.
    """

    first: np.ndarray
    """int64 [A + 1]: first operation of each action."""
    num_outer: np.ndarray
    """int64 [O]."""
    num_loops: np.ndarray
    """int64 [O]: outer and summed variables."""
    variables: np.ndarray
    """int64 [O, V]."""
    num_inputs: np.ndarray
    """int64 [O]."""
    shared: np.ndarray
    """bool [O, I]."""
    base: np.ndarray
    """int64 [O, I]."""
    strides: np.ndarray
    """int64 [O, I, V]."""
    inner: np.ndarray
    """int64 [O, I]: stride of the inner variable; 0 where the table does not have it."""
    out_base: np.ndarray
    """int64 [O]."""
    out_strides: np.ndarray
    """int64 [O, V]."""
    mixes: np.ndarray
    """bool [O]: the operation mixes rows of one table, weighted by a belief for each parent: the usual case."""
    memory: int
    """Entries of one belief's memory: belief [N, K], result [N, K], intermediate tables."""


class _Planner:
    """Plans the sums of one model."""

    def __init__(self, dbn: TwoSliceDBN, frontier: bool) -> None:
        self.dbn, self.frontier = dbn, frontier
        self.operations: list[tuple[tuple[int, ...], tuple[int, ...], list[_Tensor], _Tensor]] = []
        self.memory = 2 * dbn.num_factors * dbn.num_values

    def plan(self, action: int, factor: int) -> None:
        """Marginal of one next factor under one action."""
        dbn, n, k = self.dbn, self.dbn.num_factors, self.dbn.num_values
        pool: list[_Tensor] = []
        now: set[int] = set()
        for i in (factor,) if self.frontier else ancestors(dbn, action, (factor,)):
            axes = tuple(where * n + p for where, p in dbn.parents(action, i)) + (n + i,)
            strides = tuple(k ** (len(axes) - 1 - axis) for axis in range(len(axes)))
            pool.append(_Tensor(axes, True, int(dbn.offsets[action, i]) * k, strides))
            now |= set(dbn.parents_now[action][i])
            if self.frontier:  # parents of slice t+1 have their marginals by now, and are taken as free of each other
                now |= {n + p for p in dbn.parents_next[action][i]}
        pool += [_Tensor((p,), False, p * k, (1,)) for p in sorted(now)]
        target = n + factor
        out = _Tensor((target,), False, target * k, (1,))
        if len(pool) == 1 + len(now):
            # one table and a belief for each of its parents: its rows are mixed in one go
            self.operations.append(((target,), tuple(sorted(now)), pool, out))
            return
        waiting = {v for tensor in pool for v in tensor.scope} - {target}
        while waiting:
            variable = min(waiting, key=lambda v: (len(_scope(pool, v)), v))
            chosen = [tensor for tensor in pool if variable in tensor.scope]
            pool = [tensor for tensor in pool if variable not in tensor.scope]
            elsewhere = {v for tensor in pool for v in tensor.scope} | {target}
            scope = {v for tensor in chosen for v in tensor.scope}
            # whatever occurs nowhere else is summed out in the same loop
            result = tuple(sorted(scope & elsewhere))
            summed = tuple(sorted(scope - set(result)))
            waiting -= set(summed)
            if not pool and not waiting:
                self.operations.append((result, summed, chosen, out))
                return
            pool.append(self._sum(chosen, result, summed))
        self.operations.append(((target,), (), pool, out))

    def _sum(self, chosen: list[_Tensor], result: tuple[int, ...], summed: tuple[int, ...]) -> _Tensor:
        k = self.dbn.num_values
        strides = tuple(k ** (len(result) - 1 - axis) for axis in range(len(result)))
        out = _Tensor(result, False, self.memory, strides)
        self.memory += k ** len(result)
        if self.memory > MAX_WORKSPACE:
            raise UserError("this model is too densely connected for exact marginals; sample instead")
        self.operations.append((result, summed, chosen, out))
        return out


def _scope(pool: list[_Tensor], variable: int) -> set[int]:
    return {v for tensor in pool if variable in tensor.scope for v in tensor.scope}


def plan_updates(dbn: TwoSliceDBN, frontier: bool = False) -> Programs:
    """Plan the marginals of every factor under every action.

    Args:
        dbn: the model.
        frontier: take a factor's parents of slice t+1 as independent of all its other parents.

    Raises:
        UserError: the model is too densely connected.
    """
    planner = _Planner(dbn, frontier)
    first = [0]
    for a in range(dbn.num_actions):
        for i in dbn.order:
            planner.plan(a, i)
        first.append(len(planner.operations))
    operations = planner.operations
    mixes = [_mixes(result, tensors) for result, _, tensors, _ in operations]
    loops = [
        # rows are mixed in the order of the table, so that their weights are a Kronecker product
        _loops(result, tensors[0].scope[:-1] if mixed else summed, dbn.num_factors)
        for (result, summed, tensors, _), mixed in zip(operations, mixes, strict=True)
    ]
    inputs = max(len(tensors) for _, _, tensors, _ in operations)
    width = max(1, max(len(outer) + len(summed) for outer, summed, _ in loops))
    number = len(operations)
    programs = Programs(
        first=np.array(first, dtype=np.int64),
        num_outer=np.array([len(outer) for outer, _, _ in loops], dtype=np.int64),
        num_loops=np.array([len(outer) + len(summed) for outer, summed, _ in loops], dtype=np.int64),
        variables=np.zeros((number, width), dtype=np.int64),
        num_inputs=np.array([len(tensors) for _, _, tensors, _ in operations], dtype=np.int64),
        shared=np.zeros((number, inputs), dtype=np.bool_),
        base=np.zeros((number, inputs), dtype=np.int64),
        strides=np.zeros((number, inputs, width), dtype=np.int64),
        inner=np.zeros((number, inputs), dtype=np.int64),
        out_base=np.array([out.offset for _, _, _, out in operations], dtype=np.int64),
        out_strides=np.zeros((number, width), dtype=np.int64),
        mixes=np.array(mixes),
        memory=planner.memory,
    )
    for o, ((_, _, tensors, out), (outer, summed, inner)) in enumerate(zip(operations, loops, strict=True)):
        variables = outer + summed
        programs.variables[o, : len(variables)] = variables
        programs.out_strides[o, : len(outer)] = [_stride(out, v) for v in outer]
        for j, tensor in enumerate(tensors):
            programs.shared[o, j] = tensor.shared
            programs.base[o, j] = tensor.offset
            programs.strides[o, j, : len(variables)] = [_stride(tensor, v) for v in variables]
            programs.inner[o, j] = _stride(tensor, inner)
    return programs


def _loops(
    result: tuple[int, ...], summed: tuple[int, ...], num_factors: int
) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """Outer, summed and inner variables: the inner one is the result's last factor of slice t+1.

    Every result has one: an elimination that left none would have to be cut off from the target.
    """
    inner = max(v for v in result if v >= num_factors)
    return tuple(v for v in result if v != inner), summed, inner


def _mixes(result: tuple[int, ...], tensors: list[_Tensor]) -> bool:
    table, beliefs = tensors[0], tensors[1:]
    weighted = [tensor.scope for tensor in beliefs]
    return (
        len(result) == 1
        and table.shared
        and not any(tensor.shared for tensor in beliefs)
        and sorted(weighted) == sorted((v,) for v in table.scope[:-1])
        and all(tensor.offset == v * table.strides[-2] for tensor in beliefs for v in tensor.scope)
    )


def _stride(tensor: _Tensor, variable: int) -> int:
    return tensor.strides[tensor.scope.index(variable)] if variable in tensor.scope else 0
