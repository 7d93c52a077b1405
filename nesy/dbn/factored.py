"""Compiled, batched belief updates: exact one-step marginals for many beliefs at once.

Sums run over the support of the factors now, so certain beliefs cost next to nothing.
"""

from __future__ import annotations

import numpy as np

from nesy.compiled import njit
from nesy.dbn.elimination import Programs, plan_updates
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MOST_WEIGHTS = 4096


@njit(cache=True)
def _sum_products(
    programs: Programs,
    o: int,
    tables: np.ndarray,
    memory: np.ndarray,
    support: np.ndarray,
    sizes: np.ndarray,
    digits: np.ndarray,
    offsets: np.ndarray,
    accumulator: np.ndarray,
    product: np.ndarray,
) -> None:
    """One operation: for every combination of the outer variables, the sum over the summed ones."""
    num_values = accumulator.shape[0]
    outer, loops, inputs = programs.num_outer[o], programs.num_loops[o], programs.num_inputs[o]
    digits[:loops] = 0
    while True:
        target = programs.out_base[o]
        for position in range(outer):
            value = support[programs.variables[o, position], digits[position]]
            target += programs.out_strides[o, position] * value
        for j in range(inputs):
            offsets[j] = programs.base[o, j]
            for position in range(loops):
                value = support[programs.variables[o, position], digits[position]]
                offsets[j] += programs.strides[o, j, position] * value
        accumulator[:] = 0.0
        while True:
            weight = 1.0
            for j in range(inputs):
                if programs.inner[o, j] == 0:
                    weight *= tables[offsets[j]] if programs.shared[o, j] else memory[offsets[j]]
            if weight != 0.0:
                product[:] = weight
                for j in range(inputs):
                    stride, start = programs.inner[o, j], offsets[j]
                    if stride != 0:
                        source = tables if programs.shared[o, j] else memory
                        for k in range(num_values):
                            product[k] *= source[start + k * stride]
                for k in range(num_values):
                    accumulator[k] += product[k]
            position = loops - 1
            while position >= outer:
                variable = programs.variables[o, position]
                before = support[variable, digits[position]]
                digits[position] = digits[position] + 1 if digits[position] + 1 < sizes[variable] else 0
                step = support[variable, digits[position]] - before
                for j in range(inputs):
                    offsets[j] += programs.strides[o, j, position] * step
                if digits[position] != 0:
                    break
                position -= 1
            if position < outer:
                break
        for k in range(num_values):
            memory[target + k] = accumulator[k]
        position = outer - 1
        while position >= 0:
            variable = programs.variables[o, position]
            digits[position] = digits[position] + 1 if digits[position] + 1 < sizes[variable] else 0
            if digits[position] != 0:
                break
            position -= 1
        if position < 0:
            return


@njit(cache=True)
def _mix_rows(
    programs: Programs,
    o: int,
    tables: np.ndarray,
    memory: np.ndarray,
    support: np.ndarray,
    sizes: np.ndarray,
    digits: np.ndarray,
    starts: np.ndarray,
    weights: np.ndarray,
    kronecker: np.ndarray,
    accumulator: np.ndarray,
) -> None:
    """One operation of the usual kind; weights and row starts are kept per depth, only the last parent's change."""
    num_values = accumulator.shape[0]
    loops = programs.num_loops[o]
    total, inside = 1, 1
    for position in range(loops):
        total *= num_values
        inside *= sizes[programs.variables[o, position]]
    if total <= kronecker.shape[0] and 4 * inside >= total:
        # most rows have some weight: one matrix product
        kronecker[0] = 1.0
        count = 1
        for position in range(loops):
            start = programs.variables[o, position] * num_values
            for row in range(count - 1, -1, -1):
                scale = kronecker[row]
                for value in range(num_values):
                    kronecker[row * num_values + value] = scale * memory[start + value]
            count *= num_values
        first = programs.base[o, 0]
        block = tables[first : first + total * num_values].reshape(total, num_values)
        np.dot(kronecker[:total], block, accumulator)
        memory[programs.out_base[o] : programs.out_base[o] + num_values] = accumulator
        return
    accumulator[:] = 0.0
    starts[0], weights[0] = programs.base[o, 0], 1.0
    depth = 0
    if loops > 0:
        digits[0] = -1
    else:
        for k in range(num_values):
            accumulator[k] = tables[starts[0] + k]
    while depth >= 0 and loops > 0:
        variable = programs.variables[o, depth]
        stride = programs.strides[o, 0, depth]
        if depth == loops - 1:
            # four values at a time in registers: several times faster than adding rows in memory
            belief, start, scale = variable * num_values, starts[depth], weights[depth]
            k = 0
            while k + 4 <= num_values:
                a, b, c, d = accumulator[k], accumulator[k + 1], accumulator[k + 2], accumulator[k + 3]
                for digit in range(sizes[variable]):
                    value = support[variable, digit]
                    weight = scale * memory[belief + value]
                    row = start + stride * value + k
                    a += weight * tables[row]
                    b += weight * tables[row + 1]
                    c += weight * tables[row + 2]
                    d += weight * tables[row + 3]
                accumulator[k], accumulator[k + 1], accumulator[k + 2], accumulator[k + 3] = a, b, c, d
                k += 4
            while k < num_values:
                for digit in range(sizes[variable]):
                    value = support[variable, digit]
                    accumulator[k] += scale * memory[belief + value] * tables[start + stride * value + k]
                k += 1
            depth -= 1
        else:
            digits[depth] += 1
            if digits[depth] == sizes[variable]:
                depth -= 1
            else:
                value = support[variable, digits[depth]]
                weights[depth + 1] = weights[depth] * memory[variable * num_values + value]
                starts[depth + 1] = starts[depth] + stride * value
                depth += 1
                digits[depth] = -1
    for k in range(num_values):
        memory[programs.out_base[o] + k] = accumulator[k]


@njit(cache=True)
def _run(programs: Programs, tables: np.ndarray, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
    number, n, num_values = beliefs.shape
    result = np.empty((number, n, num_values))
    memory = np.empty(programs.memory)
    support = np.empty((2 * n, num_values), dtype=np.int64)
    sizes = np.full(2 * n, num_values, dtype=np.int64)
    for v in range(n, 2 * n):
        for k in range(num_values):
            support[v, k] = k
    digits = np.zeros(programs.variables.shape[1], dtype=np.int64)
    offsets = np.zeros(programs.base.shape[1], dtype=np.int64)
    starts = np.zeros(programs.variables.shape[1] + 1, dtype=np.int64)
    weights = np.zeros(programs.variables.shape[1] + 1)
    kronecker = np.empty(MOST_WEIGHTS)
    accumulator, product = np.empty(num_values), np.empty(num_values)
    for b in range(number):
        for i in range(n):
            sizes[i] = 0
            for k in range(num_values):
                memory[i * num_values + k] = beliefs[b, i, k]
                if beliefs[b, i, k] > 0.0:
                    support[i, sizes[i]] = k
                    sizes[i] += 1
        for o in range(programs.first[actions[b]], programs.first[actions[b] + 1]):
            if programs.mixes[o]:
                _mix_rows(programs, o, tables, memory, support, sizes, digits, starts, weights, kronecker, accumulator)
            else:
                _sum_products(programs, o, tables, memory, support, sizes, digits, offsets, accumulator, product)
        for i in range(n):
            start = (n + i) * num_values
            total = 0.0
            for k in range(num_values):
                total += memory[start + k]
            for k in range(num_values):
                result[b, i, k] = memory[start + k] / total
    return result


class FactoredUpdates:
    """Belief updates of one model, planned once."""

    def __init__(self, dbn: TwoSliceDBN, frontier: bool = False) -> None:
        """Plan the updates.

        Args:
            dbn: the model.
            frontier: the factored frontier of Murphy and Weiss (2001): parents of slice t+1 count as independent of
                each other and of those of slice t. Many times faster where such arcs are many, and not exact then;
                the same where there are none.

        Raises:
            UserError: the model is too densely connected.
        """
        self.shape = (dbn.num_factors, dbn.num_values)
        self.num_actions = dbn.num_actions
        self._programs = plan_updates(dbn, frontier)
        self._tables = np.array(dbn.probabilities).reshape(-1)

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Marginals of the next factors for many beliefs, each a product of its rows; exact unless `frontier`.

        Args:
            beliefs: float [B, N, K], rows sum to 1.
            actions: integers [B].

        Returns:
            float64 [B, N, K], rows sum to 1.

        Raises:
            UserError: wrong shapes, a row without any probability, or no such action.
        """
        beliefs = np.ascontiguousarray(beliefs, dtype=np.float64)
        actions = np.ascontiguousarray(actions, dtype=np.int64)
        if beliefs.shape[1:] != self.shape or actions.shape != beliefs.shape[:1]:
            raise UserError(
                f"beliefs have the shape [B, {self.shape[0]}, {self.shape[1]}] and actions [B], "
                f"found {list(beliefs.shape)} and {list(actions.shape)}"
            )
        if not len(beliefs):
            return beliefs
        if actions.min() < 0 or actions.max() >= self.num_actions:
            raise UserError(f"an action lies in 0..{self.num_actions - 1}")
        if not (beliefs.min() >= 0 and beliefs.sum(axis=2).min() > 0):
            raise UserError("each row of a belief needs numbers >= 0, not all of them 0")
        return np.asarray(_run(self._programs, self._tables, beliefs, actions))

    def filter(self, beliefs: np.ndarray, actions: np.ndarray, likelihoods: np.ndarray) -> np.ndarray:
        """Factored filter: exact prediction, projection to its marginals, then Bayes' rule factor by factor.

        The projection of Boyen and Koller (1998). It agrees with `TwoSliceDBN.filter` where the next
        factors are independent under the belief; where an observation of one factor tells about another
        through a shared parent, only the exact filter sees that. Fallback for an observation that the
        prediction holds impossible: the observation, where it says something, else the prediction.

        Args:
            beliefs: float [B, N, K], rows sum to 1.
            actions: integers [B].
            likelihoods: float [B, N, K] >= 0.

        Returns:
            float64 [B, N, K], rows sum to 1.

        Raises:
            UserError: as `predict`, or negative likelihoods.
        """
        predicted = self.predict(beliefs, actions)
        likelihoods = np.asarray(likelihoods, dtype=np.float64)
        if likelihoods.shape != predicted.shape or (likelihoods.size and not likelihoods.min() >= 0):
            raise UserError(f"likelihoods have the shape {list(predicted.shape)} and no negative entries")
        return np.asarray(_weigh(predicted, np.ascontiguousarray(likelihoods)))


@njit(cache=True)
def _weigh(predicted: np.ndarray, likelihoods: np.ndarray) -> np.ndarray:
    number, n, num_values = predicted.shape
    result = np.empty(predicted.shape)
    for b in range(number):
        for i in range(n):
            total, observed = 0.0, 0.0
            for k in range(num_values):
                result[b, i, k] = predicted[b, i, k] * likelihoods[b, i, k]
                total += result[b, i, k]
                observed += likelihoods[b, i, k]
            for k in range(num_values):
                if total > 0.0:
                    result[b, i, k] /= total
                elif observed > 0.0:
                    result[b, i, k] = likelihoods[b, i, k] / observed
                else:
                    result[b, i, k] = predicted[b, i, k]
    return result


def predict_batch(dbn: TwoSliceDBN, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Exact next marginals of many beliefs (see `FactoredUpdates.predict`); the plan is made anew each call."""
    return FactoredUpdates(dbn).predict(beliefs, actions)
