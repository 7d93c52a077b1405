"""Are the true parents found? Random models with known parents, transitions drawn from them, arcs compared."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nesy.dbn.learning.fitting import from_experience
from nesy.dbn.learning.structure import Search
from nesy.dbn.model import TwoSliceDBN


@dataclass(frozen=True)
class Recovery:
    """How many arcs were found."""

    right: int
    """True arcs found."""
    found: int
    """Arcs found."""
    true: int
    """True arcs."""

    @property
    def precision(self) -> float:
        """Share of the arcs found that are true."""
        return self.right / max(1, self.found)

    @property
    def recall(self) -> float:
        """Share of the true arcs that were found."""
        return self.right / max(1, self.true)


def random_model(
    rng: np.random.Generator,
    factors: int = 8,
    values: int = 8,
    parents: int = 2,
    actions: int = 1,
    concentration: float = 0.3,
) -> TwoSliceDBN:
    """A model in which every factor has exactly `parents` parents; rows are drawn from a symmetric Dirichlet."""
    now = [
        [sorted(rng.choice(factors, parents, replace=False).tolist()) for _ in range(factors)] for _ in range(actions)
    ]
    tables = [
        [rng.dirichlet(np.full(values, concentration), size=values**parents) for _ in range(factors)]
        for _ in range(actions)
    ]
    return TwoSliceDBN.from_tables(tables, now)


def random_transitions(
    dbn: TwoSliceDBN, rng: np.random.Generator, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transitions from uniformly drawn codes under uniformly drawn actions: uint8 [n, N], int64 [n], uint8 [n, N]."""
    codes = rng.integers(0, dbn.num_values, size=(number, dbn.num_factors)).astype(dbn.code_type)
    actions = rng.integers(0, dbn.num_actions, size=number)
    return codes, actions, dbn.sample(codes, actions, rng)


def compare_arcs(truth: TwoSliceDBN, found: TwoSliceDBN) -> Recovery:
    """The arcs of two models of the same factors and actions."""
    pairs = [
        (set(truth.parents(a, i)), set(found.parents(a, i)))
        for a in range(truth.num_actions)
        for i in range(truth.num_factors)
    ]
    return Recovery(sum(len(t & f) for t, f in pairs), sum(len(f) for _, f in pairs), sum(len(t) for t, _ in pairs))


def recover(seeds: Iterable[int], transitions: int = 20_000, search: Search | None = None) -> Recovery:
    """Arcs of `random_model`s recovered from transitions alone, all seeds together."""
    total = np.zeros(3, dtype=np.int64)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        truth = random_model(rng)
        taken = random_transitions(truth, rng, transitions)
        found = from_experience(
            *taken, num_values=truth.num_values, num_actions=truth.num_actions, search=search or Search(max_next=1)
        )
        one = compare_arcs(truth, found)
        total += (one.right, one.found, one.true)
    return Recovery(*total.tolist())
