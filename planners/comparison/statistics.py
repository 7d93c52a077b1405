"""Statistics of episodes that a reader can trust: means with bootstrap intervals, and what to put beside them.

Intervals are percentile bootstraps by scipy, stratified where groups (maps, seeds) are given, so that the spread
between groups that every agent meets alike does not blur the comparison. The robust measures (interquartile
mean, performance profile, probability of improvement) are those of Agarwal et al., "Deep reinforcement learning
at the edge of the statistical precipice", NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Interval:
    """An estimate with the ends of its interval."""

    mean: float
    low: float
    high: float

    def as_dict(self) -> dict[str, float]:
        """`{"mean", "low", "high"}`."""
        return asdict(self)


def bootstrap(
    values: np.ndarray,
    seed: int,
    confidence: float = 0.95,
    statistic: Callable[..., np.ndarray] = np.mean,
    resamples: int = 2000,
) -> Interval:
    """A statistic of `values` [n] with its percentile bootstrap interval.

    Args:
        values: float [n], at least one.
        seed: of the resampling.
        confidence: coverage.
        statistic: takes `axis`, as np.mean does.
        resamples: bootstrap samples.
    """
    values = np.asarray(values, np.float64)
    if len(values) == 0:
        raise ValueError("statistics need at least one episode")
    point = float(statistic(values, axis=-1))
    if len(values) == 1 or np.ptp(values) == 0.0:
        return Interval(point, point, point)
    return _percentiles([values], statistic, point, seed, confidence, resamples)


def stratified_bootstrap(
    values: np.ndarray,
    groups: np.ndarray,
    seed: int,
    confidence: float = 0.95,
    statistic: Callable[..., np.ndarray] = np.mean,
    resamples: int = 2000,
) -> Interval:
    """As `bootstrap`, but resampling within each group and pooling; `groups` [n] are labels.

    Every group is a sample of its own to scipy, so that the number of episodes of each stays as it is.
    """
    values, groups = np.asarray(values, np.float64), np.asarray(groups)
    if values.shape != groups.shape or len(values) == 0:
        raise ValueError(f"values {values.shape} and groups {groups.shape} must be of one positive length")
    point = float(statistic(values, axis=-1))
    parts = [values[groups == label] for label in np.unique(groups)]
    if all(np.ptp(part) == 0.0 for part in parts):
        return Interval(point, point, point)
    # scipy wants two of each: a group of one is resampled to itself either way.
    samples = [part if len(part) > 1 else np.repeat(part, 2) for part in parts]
    sizes = [len(part) for part in parts]

    def pooled(*resampled: np.ndarray, axis: int) -> np.ndarray:
        whole = [part[..., :size] for part, size in zip(resampled, sizes, strict=True)]
        return statistic(np.concatenate(whole, axis=-1), axis=axis)

    return _percentiles(samples, pooled, point, seed, confidence, resamples)


def cluster_bootstrap(
    values: np.ndarray,
    groups: np.ndarray,
    seed: int,
    confidence: float = 0.95,
    statistic: Callable[..., np.ndarray] = np.mean,
    resamples: int = 2000,
) -> Interval:
    """As `bootstrap`, but resampling whole groups, each with the mean of its values; `groups` [n] are labels."""
    values = np.asarray(values, np.float64)
    labels, group = np.unique(groups, return_inverse=True)
    means = np.bincount(group, values, len(labels)) / np.bincount(group, minlength=len(labels))
    found = bootstrap(means, seed, confidence, statistic, resamples)
    return Interval(float(statistic(values, axis=-1)), found.low, found.high)


def _percentiles(
    samples: list[np.ndarray],
    statistic: Callable[..., np.ndarray],
    point: float,
    seed: int,
    confidence: float,
    resamples: int,
) -> Interval:
    """The percentile interval of a statistic of independent samples, by scipy."""
    result = stats.bootstrap(
        samples,
        statistic,
        n_resamples=resamples,
        confidence_level=confidence,
        method="percentile",
        vectorized=True,
        axis=-1,
        rng=np.random.default_rng(seed),
    )
    return Interval(point, float(result.confidence_interval.low), float(result.confidence_interval.high))


def over_seeds(
    values: np.ndarray, seeds: np.ndarray, seed: int, confidence: float = 0.95, resamples: int = 5000
) -> Interval:
    """Mean of `values` [n] with an interval for the spread between seeds, labels [n]: of trained agents, the
    bootstrap resamples seeds and not episodes, as episodes of one training have that training in common.
    """  # noqa: D205
    means = np.array([np.mean(np.asarray(values)[np.asarray(seeds) == label]) for label in np.unique(seeds)])
    return bootstrap(means, seed, confidence, resamples=resamples)


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
        whole: resample whole groups (trainings), each counting alike; otherwise episodes within each group, or
            all episodes where a group of one leaves nothing to resample.
        seed: of the resampling.
        confidence: coverage.
        resamples: bootstrap samples.
    """
    rng = np.random.default_rng(seed)
    labels, group, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if whole:
        drawn = rng.multinomial(len(labels), np.full(len(labels), 1 / len(labels)), resamples)
        weights = drawn[:, group] / sizes[group]
    else:
        if sizes.min() < 2:
            group, sizes = np.zeros_like(group), np.array([len(group)])
        weights = np.zeros((resamples, len(group)))
        for label, size in enumerate(sizes):
            weights[:, group == label] = rng.multinomial(size, np.full(size, 1 / size), resamples)
    values = np.stack(list(columns.values()), axis=1)
    known = ~np.isnan(values)
    filled = np.where(known, values, 0.0)
    point = 1 / sizes[group] if whole else np.ones(len(group))
    means = (point @ filled) / (point @ known)
    with np.errstate(invalid="ignore"):  # a resample may hold no episode with a rare measure
        draws = (weights @ filled) / (weights @ known)
    tail = (1.0 - confidence) / 2
    low, high = np.nanquantile(draws, [tail, 1.0 - tail], axis=0)
    return {name: Interval(float(means[at]), float(low[at]), float(high[at])) for at, name in enumerate(columns)}


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half (25 % trimmed mean)."""
    trimmed: np.ndarray = stats.trim_mean(values, proportiontocut=0.25, axis=axis)
    return trimmed


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
    rows = rng.multinomial(len(ours), np.full(len(ours), 1 / len(ours)), resamples)
    columns = rng.multinomial(len(theirs), np.full(len(theirs), 1 / len(theirs)), resamples)
    draws = ((rows @ wins) * columns).sum(axis=1) / wins.size
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1.0 - tail])
    return Interval(float(wins.mean()), float(low), float(high))


def running_average(values: np.ndarray, window: int | None = None) -> np.ndarray:
    """Average of all values so far, or of the last `window`: float64 [n]."""
    values = np.asarray(values, np.float64)
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    start = np.zeros_like(end) if window is None else np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)
