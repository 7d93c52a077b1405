"""Compiled, batched belief updates: exact one-step marginals for many beliefs at once.

Sums run over the support of the factors now and next, so certain beliefs cost next to nothing.
"""

from __future__ import annotations

import numpy as np

from nesy.compiled import njit
from nesy.dbn.inference.elimination import Programs, plan_updates
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

MOST_WEIGHTS = 4096
BLOCK = 32
"""Beliefs that are spread over many values are mixed so many at a time: one matrix product."""


@njit(cache=True)
def _sum(
    programs: Programs,
    o: int,
    source: np.ndarray,
    memory: np.ndarray,
    support: np.ndarray,
    sizes: np.ndarray,
    loops: np.ndarray,
    digits: np.ndarray,
    places: np.ndarray,
    weights: np.ndarray,
    num_values: int,
) -> None:
    """One operation; `places` holds per depth where table, joint and out stand, `weights` the product so far."""
    row, joint, out, scale = programs.table[o], programs.joint[o], programs.out[o], 1.0
    depths, outer = 0, 0
    for place in range(programs.num_loops[o]):
        variable = programs.variables[o, place]
        if sizes[variable] == 1:
            # no loop: its only value counts once and for all
            value = support[variable, 0]
            row += programs.table_strides[o, place] * value
            joint += programs.joint_strides[o, place] * value
            out += programs.out_strides[o, place] * value
            scale *= memory[programs.beliefs[o, place] + value]
        else:
            loops[depths] = place
            depths += 1
            outer += place < programs.num_outer[o]
    if depths == 0:
        scale *= memory[joint]
        for k in range(num_values):
            memory[out + k] = scale * source[row + k]
        return
    places[0, 0], places[0, 1], places[0, 2], weights[0], digits[0] = row, joint, out, scale, -1
    depth = 0
    while depth >= 0:
        place = loops[depth]
        variable, belief = programs.variables[o, place], programs.beliefs[o, place]
        step, joint_step = programs.table_strides[o, place], programs.joint_strides[o, place]
        row, joint, out, scale = places[depth, 0], places[depth, 1], places[depth, 2], weights[depth]
        if depth == outer and digits[depth] == -1:
            for k in range(num_values):
                memory[out + k] = 0.0
        if depth < depths - 1:
            digits[depth] += 1
            if digits[depth] == sizes[variable]:
                depth -= 1
                continue
            value = support[variable, digits[depth]]
            depth += 1
            places[depth, 0], places[depth, 1] = row + step * value, joint + joint_step * value
            places[depth, 2] = out + programs.out_strides[o, place] * value
            weights[depth] = scale * memory[belief + value]
            digits[depth] = -1
            continue
        if depth < outer:
            out_step = programs.out_strides[o, place]
            for digit in range(sizes[variable]):
                value = support[variable, digit]
                weight = scale * memory[belief + value] * memory[joint + joint_step * value]
                here, there = row + step * value, out + out_step * value
                for k in range(num_values):
                    memory[there + k] = weight * source[here + k]
        else:
            # eight or four values at a time in registers: several times faster than adding rows in memory
            k = 0
            while k + 8 <= num_values:
                at = out + k
                a, b, c, d = memory[at], memory[at + 1], memory[at + 2], memory[at + 3]
                e, f, g, h = memory[at + 4], memory[at + 5], memory[at + 6], memory[at + 7]
                for digit in range(sizes[variable]):
                    value = support[variable, digit]
                    weight = scale * memory[belief + value] * memory[joint + joint_step * value]
                    here = row + step * value + k
                    a += weight * source[here]
                    b += weight * source[here + 1]
                    c += weight * source[here + 2]
                    d += weight * source[here + 3]
                    e += weight * source[here + 4]
                    f += weight * source[here + 5]
                    g += weight * source[here + 6]
                    h += weight * source[here + 7]
                memory[at], memory[at + 1], memory[at + 2], memory[at + 3] = a, b, c, d
                memory[at + 4], memory[at + 5], memory[at + 6], memory[at + 7] = e, f, g, h
                k += 8
            while k + 4 <= num_values:
                a, b, c, d = memory[out + k], memory[out + k + 1], memory[out + k + 2], memory[out + k + 3]
                for digit in range(sizes[variable]):
                    value = support[variable, digit]
                    weight = scale * memory[belief + value] * memory[joint + joint_step * value]
                    here = row + step * value + k
                    a += weight * source[here]
                    b += weight * source[here + 1]
                    c += weight * source[here + 2]
                    d += weight * source[here + 3]
                memory[out + k], memory[out + k + 1], memory[out + k + 2], memory[out + k + 3] = a, b, c, d
                k += 4
            while k < num_values:
                total = memory[out + k]
                for digit in range(sizes[variable]):
                    value = support[variable, digit]
                    weight = scale * memory[belief + value] * memory[joint + joint_step * value]
                    total += weight * source[row + step * value + k]
                memory[out + k] = total
                k += 1
        depth -= 1


@njit(cache=True)
def _mix(
    programs: Programs,
    o: int,
    tables: np.ndarray,
    beliefs: np.ndarray,
    chosen: np.ndarray,
    kronecker: np.ndarray,
    mixed: np.ndarray,
) -> None:
    """One operation that mixes rows, for a block of beliefs: their weights are Kronecker products."""
    num_values, loops = beliefs.shape[2], programs.num_loops[o]
    last = programs.variables[o, loops - 1]
    count = num_values ** (loops - 1)
    weights = kronecker[: len(chosen) * count].reshape(len(chosen), count)
    for b in range(len(chosen)):
        weights[b, 0] = 1.0
        filled = 1
        for place in range(loops - 1):
            factor = programs.variables[o, place]
            for row in range(filled - 1, -1, -1):
                scale = weights[b, row]
                for value in range(num_values):
                    weights[b, row * num_values + value] = scale * beliefs[chosen[b], factor, value]
            filled *= num_values
    # one matrix product for all parents but the last, whose values lie side by side with those of the factor
    start, width = programs.table[o], num_values * num_values
    product = np.dot(weights, tables[start : start + count * width].reshape(count, width))
    for b in range(len(chosen)):
        for k in range(num_values):
            total = 0.0
            for value in range(num_values):
                total += beliefs[chosen[b], last, value] * product[b, value * num_values + k]
            mixed[b, programs.target[o], k] = total


@njit(cache=True)
def _is_dense(programs: Programs, o: int, counts: np.ndarray, chosen: np.ndarray, num_values: int) -> bool:
    """Whether most rows that the operation mixes have some weight in most of the beliefs."""
    rows, held = float(num_values) ** programs.num_loops[o], 0.0
    if rows > MOST_WEIGHTS * num_values or rows < num_values:
        return False
    for b in range(len(chosen)):
        inside = 1.0
        for place in range(programs.num_loops[o]):
            inside *= counts[chosen[b], programs.variables[o, place]]
        held += inside
    return 12.0 * held >= rows * len(chosen)


@njit(cache=True)
def _run(
    programs: Programs, tables: np.ndarray, beliefs: np.ndarray, actions: np.ndarray, order: np.ndarray
) -> np.ndarray:
    number, n, num_values = beliefs.shape
    result = np.empty((number, n, num_values))
    memory = np.empty(programs.memory)
    memory[2 * n * num_values : (2 * n + 1) * num_values] = 1.0
    support = np.empty((2 * n, num_values), dtype=np.int64)
    sizes = np.zeros(2 * n, dtype=np.int64)
    width = programs.variables.shape[1]
    loops, digits = np.zeros(width + 1, dtype=np.int64), np.zeros(width + 1, dtype=np.int64)
    weights = np.zeros(width + 1)
    places = np.zeros((width + 1, 3), dtype=np.int64)
    counts = np.zeros((number, n), dtype=np.int64)
    for b in range(number):
        for i in range(n):
            for k in range(num_values):
                if beliefs[b, i, k] > 0.0:
                    counts[b, i] += 1
    kronecker, mixed = np.empty(BLOCK * MOST_WEIGHTS), np.empty((BLOCK, n, num_values))
    start = 0
    while start < number:
        action = actions[order[start]]
        stop = start
        while stop < number and stop < start + BLOCK and actions[order[stop]] == action:
            stop += 1
        chosen = order[start:stop]
        first, last = programs.first[action], programs.first[action + 1]
        done = np.zeros(last - first, dtype=np.bool_)
        for o in range(first, last):
            if programs.mixes[o] and _is_dense(programs, o, counts, chosen, num_values):
                _mix(programs, o, tables, beliefs, chosen, kronecker, mixed)
                done[o - first] = True
        for position in range(len(chosen)):
            b = chosen[position]
            for i in range(n):
                sizes[i] = 0
                for k in range(num_values):
                    memory[i * num_values + k] = beliefs[b, i, k]
                    if beliefs[b, i, k] > 0.0:
                        support[i, sizes[i]] = k
                        sizes[i] += 1
            for o in range(first, last):
                target = programs.target[o]
                here = (n + target) * num_values
                if done[o - first]:
                    memory[here : here + num_values] = mixed[position, target]
                elif programs.shared[o]:
                    _sum(programs, o, tables, memory, support, sizes, loops, digits, places, weights, num_values)
                else:
                    _sum(programs, o, memory, memory, support, sizes, loops, digits, places, weights, num_values)
                if programs.out[o] == here:
                    # the marginal is the last that is made of a factor: from now on its support is known
                    sizes[n + target] = 0
                    for k in range(num_values):
                        if memory[here + k] > 0.0:
                            support[n + target, sizes[n + target]] = k
                            sizes[n + target] += 1
            for i in range(n):
                here = (n + i) * num_values
                total = 0.0
                for k in range(num_values):
                    total += memory[here + k]
                for k in range(num_values):
                    result[b, i, k] = memory[here + k] / total
        start = stop
    return result


class FactoredUpdates:
    """Belief updates of one model, planned once."""

    def __init__(self, dbn: TwoSliceDBN) -> None:
        """Plan the updates.

        Args:
            dbn: the model.

        Raises:
            UserError: the model is too densely connected.
        """
        self.shape = (dbn.num_factors, dbn.num_values)
        self.num_actions = dbn.num_actions
        self._programs = plan_updates(dbn)
        self._tables = np.array(dbn.probabilities).reshape(-1)

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Marginals of the next factors for many beliefs, each a product of its rows, exactly.

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
        return np.asarray(_run(self._programs, self._tables, beliefs, actions, np.argsort(actions, kind="stable")))

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
