"""Statistics of plain values: means with bootstrap intervals, and what to put beside them.

Which chance episodes went through, and what is to be resampled then, planners.comparison.chance says. The
robust measures (interquartile mean, performance profile, probability of improvement) are those of Agarwal et al.,
"Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from planners.comparison.chance import Chance, Interval, drawn
from planners.comparison.chance import interquartile_mean as interquartile_mean


def bootstrap(values: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 2000) -> Interval:
    """Mean of `values` [n] with its percentile bootstrap interval.

    Args:
        values: float [n], at least one; of one alone there is no interval.
        seed: of the resampling.
        confidence: coverage.
        resamples: bootstrap samples.
    """
    values = np.asarray(values, np.float64)
    if len(values) == 0:
        raise ValueError("statistics need at least one episode")
    return Chance(len(values), None, None, None, confidence, resamples, seed).mean(values, shares=False)


def stratified_bootstrap(
    values: np.ndarray, groups: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 2000
) -> Interval:
    """As `bootstrap`, but resampling within each group; `groups` [n] are labels."""
    values, groups = np.asarray(values, np.float64), np.asarray(groups)
    if values.shape != groups.shape or len(values) == 0:
        raise ValueError(f"values {values.shape} and groups {groups.shape} must be of one positive length")
    return Chance(len(values), None, None, groups, confidence, resamples, seed).mean(values, shares=False)


def cluster_bootstrap(
    values: np.ndarray, groups: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 2000
) -> Interval:
    """As `bootstrap`, but resampling whole groups; `groups` [n] are labels."""
    values = np.asarray(values, np.float64)
    return Chance(len(values), None, groups, None, confidence, resamples, seed).mean(values, shares=False)


def over_seeds(
    values: np.ndarray, seeds: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 5000
) -> Interval:
    """Mean of `values` [n] with an interval for the spread between seeds, labels [n]: of trained agents, the
    bootstrap resamples seeds and not episodes, as episodes of one training have that training in common.
    """  # noqa: D205
    means = np.array([np.mean(np.asarray(values)[np.asarray(seeds) == label]) for label in np.unique(seeds)])
    return bootstrap(means, seed, confidence, resamples)


def means_with_intervals(
    columns: Mapping[str, np.ndarray],
    groups: np.ndarray,
    whole: bool,
    seed: int,
    confidence: float = 0.95,
    resamples: int = 1000,
) -> dict[str, Interval]:
    """Means of many measures of the same episodes, all from the same resamples.

    Args:
        columns: float [n] each, with NaN where an episode has no such measure; none is NaN throughout.
        groups: labels [n].
        whole: resample whole groups (trainings); otherwise episodes within each group, or all episodes where a group
            of one leaves nothing to resample.
        seed: of the resampling.
        confidence: coverage.
        resamples: bootstrap samples.
    """
    strata = None if whole or np.unique(groups, return_counts=True)[1].min() < 2 else groups
    chance = Chance(len(groups), groups if whole else None, None, strata, confidence, resamples, seed)
    return chance.means(columns, shares=False)


def performance_profile(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of `values` [n] above each of `thresholds` [m]: float64 [m]."""
    return (np.asarray(values)[None, :] > np.asarray(thresholds)[:, None]).mean(axis=1)


def probability_of_improvement(
    ours: np.ndarray, theirs: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 500
) -> Interval:
    """P(an episode of ours beats one of theirs), ties counting one half, with a bootstrap interval."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    # Of every pair once, as stats.mannwhitneyu counts; a resample then only weighs rows and columns anew.
    wins = np.sign(ours[:, None] - theirs[None, :]) / 2 + 0.5
    rng = np.random.default_rng(seed)
    rows, columns = (drawn(rng, len(played), resamples) for played in (ours, theirs))
    draws = ((rows @ wins) * columns).sum(axis=1) / wins.size
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1.0 - tail])
    return holding(float(wins.mean()), low, high)


def holding(mean: float, low: float, high: float) -> Interval:
    """An interval that holds its estimate; rounded, as sums of weights are to stay exactly 0.5 and 1."""
    found = np.round([mean, min(low, mean), max(high, mean)], 12)
    return Interval(*found.tolist())


def running_average(values: np.ndarray, window: int | None = None) -> np.ndarray:
    """Average of all values so far, or of the last `window`: float64 [n]."""
    values = np.asarray(values, np.float64)
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    start = np.zeros_like(end) if window is None else np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)
