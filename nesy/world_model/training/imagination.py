"""Imagined rollouts: how far ahead a world model sees when it is told the actions that were really taken."""

from __future__ import annotations

import numpy as np

from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.columns import Columns
from nesy.world_model.rolling import Rollout

HORIZONS = (1, 2, 4, 8)


def starts_of(
    columns: Columns, length: int, most: int, rng: np.random.Generator, maps: np.ndarray | None = None
) -> np.ndarray:
    """Rows from which an episode goes on for `length` unobstructed steps at least: at most `most`, int64.

    Args:
        columns: steps in the order of the episodes.
        length: of the walks.
        most: how many rows to draw.
        rng: draws them.
        maps: bool [M], walks on these maps alone.
    """
    count = len(columns)
    if count < length:
        return np.zeros(0, dtype=np.int64)
    last = count - length + 1
    fits = columns.episode[:last] == columns.episode[length - 1 :]
    blocked = np.concatenate([[0], np.cumsum(~columns.free, dtype=np.int32)])
    fits &= blocked[length:] == blocked[:last]
    if maps is not None:
        fits &= maps[columns.place[:last]]
    return np.sort(rng.permutation(np.flatnonzero(fits))[:most])


def imagined_rollouts(
    codec: SymbolicCodec,
    columns: Columns,
    rng: np.random.Generator,
    most: int = 200,
    maps: np.ndarray | None = None,
) -> dict[str, dict[str, float]]:
    """The likeliest view after 1, 2, 4 and 8 imagined steps against the one really met.

    Args:
        codec: of the model.
        columns: steps in the order of the episodes.
        rng: draws the starts.
        most: number of starts.
        maps: bool [M], walks on these maps alone.

    Returns:
        Per horizon `exact` (share of views) and `cells`; empty where no episode is long enough.
    """
    longest = HORIZONS[-1]
    rows = starts_of(columns, longest, most, rng, maps)
    if not len(rows):
        return {}
    codes = codec.codes(columns.views[columns.source[rows]])
    packed = codec.packed()
    rollout = None if packed is None else Rollout(packed)
    beliefs = codec.certain(codes)
    index = np.arange(len(rows))
    start, code, mass = index, np.zeros(0, np.int64), np.ones(len(rows))
    if rollout is not None:
        code = rollout.keys(codes)
    figures = {}
    for step in range(longest):
        action = columns.action[rows + step].astype(np.int64)
        if rollout is None:
            beliefs = codec.predict(beliefs, action)
            likeliest = beliefs.argmax(-1).astype(np.uint8)
        else:
            start, code, mass = rollout.step(start, code, mass, action[start])
            best = np.lexsort((-mass, start))[np.searchsorted(start, index)]
            likeliest = rollout.codes(code[best])
        if step + 1 in HORIZONS:
            met = columns.views[columns.target[rows + step]]
            right = (codec.views(likeliest) == met).reshape(len(rows), -1)
            figures[str(step + 1)] = {"exact": float(right.all(1).mean()), "cells": float(right.mean())}
    return figures
