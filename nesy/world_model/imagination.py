"""Imagined rollouts: how far ahead a world model sees when it is told the actions that were really taken."""

from __future__ import annotations

import numpy as np

from nesy.experience import Experience
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import unobstructed
from nesy.world_model.rolling import Rollout

HORIZONS = (1, 2, 4, 8)


def starts_of(experience: Experience, length: int, most: int, rng: np.random.Generator) -> np.ndarray:
    """Rows from which an episode goes on for `length` unobstructed steps at least: at most `most`, int64."""
    count = len(experience)
    if count < length:
        return np.zeros(0, dtype=np.int64)
    rows = np.arange(count - length + 1)
    same = experience.episode[rows] == experience.episode[rows + length - 1]
    blocked = np.concatenate([[0], np.cumsum(~unobstructed(experience))])
    rows = rows[same & (blocked[rows + length] == blocked[rows])]
    return np.sort(rng.permutation(rows)[:most])


def imagined_rollouts(
    codec: SymbolicCodec, experience: Experience, rng: np.random.Generator, most: int = 200
) -> dict[str, dict[str, float]]:
    """The likeliest view after 1, 2, 4 and 8 imagined steps against the one really met.

    Args:
        codec: of the model.
        experience: rows in the order of the episodes.
        rng: draws the starts.
        most: number of starts.

    Returns:
        Per horizon `exact` (share of views) and `cells`; empty where no episode is long enough.
    """
    longest = HORIZONS[-1]
    rows = starts_of(experience, longest, most, rng)
    if not len(rows):
        return {}
    codes = codec.codes(experience.view[rows])
    packed = codec.packed()
    rollout = None if packed is None else Rollout(packed)
    beliefs = codec.certain(codes)
    index = np.arange(len(rows))
    start, code, mass = index, np.zeros(0, np.int64), np.ones(len(rows))
    if rollout is not None:
        code = rollout.keys(codes)
    figures = {}
    for step in range(longest):
        action = experience.action[rows + step].astype(np.int64)
        if rollout is None:
            beliefs = codec.predict(beliefs, action)
            likeliest = beliefs.argmax(-1).astype(np.uint8)
        else:
            start, code, mass = rollout.step(start, code, mass, action[start])
            best = np.lexsort((-mass, start))[np.searchsorted(start, index)]
            likeliest = rollout.codes(code[best])
        if step + 1 in HORIZONS:
            right = (codec.views(likeliest) == experience.next_view[rows + step]).reshape(len(rows), -1)
            figures[str(step + 1)] = {"exact": float(right.all(1).mean()), "cells": float(right.mean())}
    return figures
