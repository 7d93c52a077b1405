"""Walks through the influence-augmented local model, for every search by sampled walks.

A step shows the robot's own motion, and the person's pose where it is in view; the 8^8 codes are sampled, but not
branched on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nesy.compiled import njit
from planners.person_following import ialm
from planners.person_following.ialm import SCALARS
from planners.person_following.kernels import Model, step
from planners.search.random_bits import uniform
from planners.search.walk import Kernels, register


class LocalModel(NamedTuple):
    """The influence-augmented local model, and what its leaves are worth; beliefs are particles int16 [P, 2N + 5]."""

    model: Model
    leaf_values: np.ndarray  # float64 [2W + 1, 2W + 1, 4, L]


def _local_room(model: LocalModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = model.model.dbn.order.shape[0]
    return (
        np.zeros(2 * n + ialm.STATE_SCALARS, np.int16),
        np.zeros(2 * n + ialm.STATE_SCALARS, np.int16),
        np.zeros(3 * n + len(SCALARS), np.int16),
    )


def _local_begin(model: LocalModel, belief: np.ndarray, state: np.ndarray, bits: np.ndarray) -> bool:
    particle = np.int64(uniform(bits) * belief.shape[0])
    for i in range(state.shape[0]):
        state[i] = belief[particle, i]
    return True


def _local_advance(
    model: LocalModel, state: np.ndarray, action: int, after: np.ndarray, scratch: np.ndarray, bits: np.ndarray
) -> tuple[float, bool, int, float]:
    n = model.model.dbn.order.shape[0]
    reward, outcome, visible = step(model.model, state, action, after, scratch, bits)
    lost = min(int(after[2 * n + 4]), model.leaf_values.shape[3] - 1)
    leaf = model.leaf_values[after[2 * n], after[2 * n + 1], after[2 * n + 2], lost]
    return reward, outcome != 0, seen_key(scratch, after, n, visible), leaf


@njit(cache=True)
def seen_key(scratch: np.ndarray, after: np.ndarray, n: int, visible: int) -> int:
    """What a step of the local model shows, as one integer: the robot's motion, and the person's pose if in view."""
    key = int(scratch[3 * n + ialm.MOTION])
    if visible != 0:
        key += 4 * ((int(after[2 * n]) * 512 + after[2 * n + 1]) * 4 + after[2 * n + 2] + 1)
    return key


register(LocalModel, Kernels(_local_room, _local_begin, _local_advance))
