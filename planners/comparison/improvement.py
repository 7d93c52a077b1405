"""Probability of improvement: how often an episode of one agent beats an episode of another on the same map.

    P(X > Y) = sum_m w_m P(X_m > Y_m),  ties one half;  w_m: the share of map m among their episodes

Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021, with maps as
tasks: without them an episode on a hopeless map would lose against any on an easy one, whoever plays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planners.comparison.chance import Interval, drawn
from planners.comparison.statistics import holding, probability_of_improvement


class Played(NamedTuple):
    """Episodes of one agent under one condition.

    Attributes:
        returns: float [n].
        maps: int [n], what was played on.
        trainings: int [n], the training that each belongs to; None where trainings are not to be resampled.
    """

    returns: np.ndarray
    maps: np.ndarray
    trainings: np.ndarray | None = None


def improvement(
    ours: Played,
    theirs: Played,
    seed: int,
    confidence: float = 0.95,
    resamples: int = 200,
    sampled: bool = False,
) -> tuple[Interval, int]:
    """The probability with its percentile bootstrap interval, and on how many maps it rests.

    Resampled are trainings, where there are any; episodes within each map, or, where maps come but once or are a
    sample (`sampled`), maps: the wider of both. Agents that have met no map in common are compared regardless of maps
    (0 maps).
    """
    common = np.intersect1d(ours.maps, theirs.maps)
    if not len(common):
        return probability_of_improvement(ours.returns, theirs.returns, seed, confidence, resamples), 0
    at = [(np.flatnonzero(ours.maps == name), np.flatnonzero(theirs.maps == name)) for name in common]
    weights = np.array([len(i) / len(ours.maps) + len(j) / len(theirs.maps) for i, j in at])
    weights /= weights.sum()
    wins = [np.sign(ours.returns[i][:, None] - theirs.returns[j][None, :]) / 2 + 0.5 for i, j in at]
    mean = float(weights @ [part.mean() for part in wins])
    rng = np.random.default_rng(seed)
    if not sampled and min(min(part.shape) for part in wins) > 1:
        draws = np.zeros((1, resamples))
        for weight, part in zip(weights, wins, strict=True):
            rows, columns = (_drawn(rng, count, resamples) for count in part.shape)
            draws += weight * ((rows @ part) * columns).sum(axis=1)
    else:
        chosen = rng.multinomial(len(common), weights, resamples) / len(common)
        draws = (chosen @ [part.mean() for part in wins])[None]
    if ours.trainings is not None or theirs.trainings is not None:
        draws = np.stack([*draws, _over_trainings(ours, theirs, at, weights, wins, rng, resamples)])
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1.0 - tail], axis=1)
    return holding(mean, low.min(), high.max()), len(common)


def _drawn(rng: np.random.Generator, count: int, resamples: int) -> np.ndarray:
    """Shares of `count` things in each resample: float64 [resamples, count]."""
    return drawn(rng, count, resamples) / count


def _over_trainings(
    ours: Played,
    theirs: Played,
    at: list[tuple[np.ndarray, np.ndarray]],
    weights: np.ndarray,
    wins: list[np.ndarray],
    rng: np.random.Generator,
    resamples: int,
) -> np.ndarray:
    """Resamples of the probability, by that of each training of ours against each of theirs: float64 [resamples]."""
    sides = []
    for played in (ours, theirs):
        labels = np.zeros(len(played.maps)) if played.trainings is None else played.trainings
        sides.append((labels[:, None] == np.unique(labels)[None, :]).astype(np.float64))
    total = np.zeros((sides[0].shape[1], sides[1].shape[1]))
    weight_of = np.zeros_like(total)
    for (i, j), weight, part in zip(at, weights, wins, strict=True):
        rows, columns = sides[0][i], sides[1][j]
        pairs = np.outer(rows.sum(axis=0), columns.sum(axis=0))
        total += weight * (rows.T @ part @ columns) / np.maximum(pairs, 1)
        weight_of += weight * (pairs > 0)
    probability = total / np.maximum(weight_of, 1e-300)
    met = (weight_of > 0).astype(np.float64)
    rows, columns = (_drawn(rng, count, resamples) for count in total.shape)
    drawn = ((rows @ (probability * met)) * columns).sum(axis=1)
    return np.asarray(drawn / np.maximum(((rows @ met) * columns).sum(axis=1), 1e-300))
