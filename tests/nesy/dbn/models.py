"""Small random models and a toy network for the tests."""

from __future__ import annotations

import itertools

import numpy as np

from nesy.dbn.model import TwoSliceDBN


def random_dbn(
    rng: np.random.Generator,
    num_factors: int = 3,
    num_values: int = 3,
    num_actions: int = 2,
    max_parents: int = 2,
    arcs: bool = True,
    concentration: float = 0.5,
    zeros: bool = False,
) -> TwoSliceDBN:
    """A random model; with `zeros`, many entries are exactly 0."""
    order = rng.permutation(num_factors)
    now, later, tables, counts = [], [], [], []
    for _ in range(num_actions):
        now.append([])
        later.append([])
        tables.append([])
        counts.append([])
        for i in range(num_factors):
            earlier = [int(j) for j in order[: list(order).index(i)]] if arcs else []
            nows = rng.choice(num_factors, size=rng.integers(0, max_parents + 1), replace=False)
            nexts = rng.choice(earlier, size=rng.integers(0, min(2, len(earlier)) + 1), replace=False)
            rows = num_values ** (len(nows) + len(nexts))
            table = rng.dirichlet(np.full(num_values, concentration), size=rows)
            if zeros:
                table = np.where(table < 0.2, 0.0, table)
                table /= table.sum(axis=1, keepdims=True)
            now[-1].append([int(p) for p in nows])
            later[-1].append([int(p) for p in nexts])
            tables[-1].append(table)
            counts[-1].append(rng.integers(0, 3, size=rows))
    return TwoSliceDBN.from_tables(tables, now, later, counts=counts, order=[int(i) for i in order])


def all_codes(dbn: TwoSliceDBN) -> np.ndarray:
    """Every code, [K^N, N]."""
    return np.array(list(itertools.product(range(dbn.num_values), repeat=dbn.num_factors)))


def transition_matrix(dbn: TwoSliceDBN, action: int) -> np.ndarray:
    """T [K^N, K^N] by brute force: one product of table entries per pair of codes."""
    codes = all_codes(dbn)
    matrix = np.ones((len(codes), len(codes)))
    for x, code in enumerate(codes):
        for y, later in enumerate(codes):
            for i in range(dbn.num_factors):
                row = 0
                for p in dbn.parents_now[action][i]:
                    row = row * dbn.num_values + code[p]
                for p in dbn.parents_next[action][i]:
                    row = row * dbn.num_values + later[p]
                matrix[x, y] *= dbn.cpt(action, i)[row, later[i]]
    return matrix


def joint(belief: np.ndarray) -> np.ndarray:
    """The product distribution over all codes, [K^N]."""
    codes = all_codes_of(belief)
    return np.array([np.prod(belief[np.arange(len(belief)), list(code)]) for code in codes])


def all_codes_of(belief: np.ndarray) -> list[tuple[int, ...]]:
    return list(itertools.product(range(belief.shape[1]), repeat=belief.shape[0]))


def marginals_of(distribution: np.ndarray, dbn: TwoSliceDBN) -> np.ndarray:
    """Marginals [N, K] of a distribution over all codes."""
    codes = all_codes(dbn)
    return np.stack(
        [np.bincount(codes[:, i], weights=distribution, minlength=dbn.num_values) for i in range(dbn.num_factors)]
    )
