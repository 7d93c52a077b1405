"""Statistics of episodes that a reader can trust: means with bootstrap intervals, and what to put beside them.

Intervals are percentile bootstraps by scipy, stratified where groups (maps, seeds) are given, so that the spread
between groups that every agent meets alike does not blur the comparison. The robust measures (interquartile
mean, performance profile, probability of improvement) are those of Agarwal et al., "Deep reinforcement learning
at the edge of the statistical precipice", NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Callable
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
    result = stats.bootstrap(
        (values,),
        statistic,
        n_resamples=resamples,
        confidence_level=confidence,
        method="percentile",
        vectorized=True,
        axis=-1,
        rng=np.random.default_rng(seed),
    )
    return Interval(point, float(result.confidence_interval.low), float(result.confidence_interval.high))


def stratified_bootstrap(
    values: np.ndarray,
    groups: np.ndarray,
    seed: int,
    confidence: float = 0.95,
    statistic: Callable[..., np.ndarray] = np.mean,
    resamples: int = 2000,
) -> Interval:
    """As `bootstrap`, but resampling within each group and pooling; `groups` [n] are labels."""
    values, groups = np.asarray(values, np.float64), np.asarray(groups)
    if values.shape != groups.shape or len(values) == 0:
        raise ValueError(f"values {values.shape} and groups {groups.shape} must be of one positive length")
    rng = np.random.default_rng(seed)
    parts = []
    for label in np.unique(groups):
        members = values[groups == label]
        parts.append(members[rng.integers(len(members), size=(resamples, len(members)))])
    estimates = statistic(np.concatenate(parts, axis=1), axis=-1)
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(estimates, [tail, 1.0 - tail])
    return Interval(float(statistic(values, axis=-1)), float(low), float(high))


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half (25 % trimmed mean)."""
    trimmed: np.ndarray = stats.trim_mean(values, proportiontocut=0.25, axis=axis)
    return trimmed


def performance_profile(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of `values` [n] above each of `thresholds` [m]: float64 [m]."""
    return (np.asarray(values)[None, :] > np.asarray(thresholds)[:, None]).mean(axis=1)


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray, seed: int, resamples: int = 2000) -> Interval:
    """P(an episode of ours beats one of theirs), ties counting one half, with a bootstrap interval."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)

    def probability(a: np.ndarray, b: np.ndarray) -> float:
        statistic = stats.mannwhitneyu(a, b, alternative="greater").statistic
        return float(statistic / (len(a) * len(b)))

    rng = np.random.default_rng(seed)
    draws = [
        probability(ours[rng.integers(len(ours), size=len(ours))], theirs[rng.integers(len(theirs), size=len(theirs))])
        for _ in range(min(resamples, 500))
    ]
    low, high = np.quantile(draws, [0.025, 0.975])
    return Interval(probability(ours, theirs), float(low), float(high))


def running_average(values: np.ndarray, window: int | None = None) -> np.ndarray:
    """Average of all values so far, or of the last `window`: float64 [n]."""
    values = np.asarray(values, np.float64)
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    start = np.zeros_like(end) if window is None else np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)
