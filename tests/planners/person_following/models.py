"""Small models that every planner test can afford."""

from __future__ import annotations

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from planners.models.tables import DecisionTable, Parents, learn_distribution, learn_mean
from planners.person_following.ialm import IALM, MAX_DISTANCE, SCALARS
from planners.person_following.motion import RelativeMotion

N, K = 2, 2


def small_dbn(rng: np.random.Generator, num_actions: int = 4) -> TwoSliceDBN:
    """A random 2DBN with two binary factors; the second depends on the first of the next slice."""
    cpts = [[rng.dirichlet(np.ones(K), size=K), rng.dirichlet(np.ones(K), size=K * K)] for _ in range(num_actions)]
    now = [[(0,), (1,)] for _ in range(num_actions)]
    nxt = [[(), (0,)] for _ in range(num_actions)]
    return TwoSliceDBN.from_tables(cpts, now, nxt, action_names=("left", "right", "forward", "stay"))


def identity_motion(window: int = 2) -> RelativeMotion:
    """Each own `forward` takes one step ahead off, each of the person's adds one; turns change nothing."""
    coefficients = np.tile(np.eye(2, 3, dtype=np.int64), (4, 4, 4, 1, 1))
    coefficients[2, :, :, 1, 2] -= 1
    coefficients[:, 2, :, 1, 2] += 1
    heading = np.tile(np.arange(4), (4, 4, 1))
    return RelativeMotion(coefficients, heading, np.ones((4, 4, 4, 2), np.int64), window)


def _table(classes: int, slots: tuple[int, ...], names: tuple[str, ...], rng: np.random.Generator) -> DecisionTable:
    """A distribution over `classes` from random examples over the given parents."""
    size = 3 * N + len(SCALARS)
    variables = np.zeros((400, size), np.int32)
    for slot in slots:
        variables[:, slot] = rng.integers(0, K, 400)
    key = variables[:, list(slots)].sum(axis=1) if slots else np.zeros(400, np.int64)
    target = (key + (rng.random(400) < 0.3)) % classes
    return learn_distribution(variables, Parents(names, slots, (False,) * len(slots)), target.astype(np.int64), classes)


def small_ialm(seed: int = 0, ends: bool = False) -> IALM:
    """An IALM over N = 2 binary factors with random tables; the person is always in view within the window."""
    rng = np.random.default_rng(seed)
    dbn = small_dbn(rng)
    base = 3 * N
    ordered = {name: base + i for i, name in enumerate(SCALARS)}
    size = base + len(SCALARS)
    ahead = np.zeros((200, size), np.int32)
    ahead[:, ordered["next_ahead"]] = rng.integers(0, 5, 200)
    here = ahead[:, ordered["next_ahead"]]
    next_ahead = Parents(("next_ahead",), (ordered["next_ahead"],), (True,))
    tables = {
        "moved": _table(2, (0,), ("x0",), rng),
        "waits": _table(2, (N,), ("next_x0",), rng),
        "influence": _table(3, (2 * N, 2 * N + 1), ("y0", "y1"), rng),
        "next_waiting": learn_distribution(np.zeros((5, size), np.int32), next_ahead, np.zeros(5, np.int64), 2),
        "distance": learn_distribution(ahead, next_ahead, here.astype(np.int64), MAX_DISTANCE + 1),
        "next_lost": learn_distribution(np.zeros((5, size), np.int32), next_ahead, np.zeros(5, np.int64), 2),
        "visible": learn_distribution(ahead, next_ahead, (here > 0).astype(np.int64), 2),
        "outcome": learn_distribution(ahead, next_ahead, (here == 4).astype(np.int64) * int(ends), 2),
        "reward": learn_mean(ahead, next_ahead, (here == 3).astype(np.float64)),
    }
    return IALM(
        dbn=dbn,
        motion=identity_motion(),
        tables=tables,
        known_codes=np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.uint8),
        person_counts=np.ones(4),
        initial_poses=np.array([[0, 0, 3], [0, 1, 3]], np.int16),
        initial_pose_counts=np.array([3, 1]),
        initial_waiting=np.array([4, 0]),
        leaf_values=np.zeros((5, 5, 4, 2)),
        view_size=5,
        provenance={"test": True},
    )
