"""What chance went through the episodes of one agent, and the intervals that follow from it.

    trainings   of an agent that learns, two or more: resampled whole
    maps        where those played are a sample of more: resampled whole
    episodes    always: within each map where maps are fixed and come more than once, else all of them

Every level is resampled by itself: of k units k - 1 are drawn with replacement and weighed up by k / (k - 1), so that
the draws spread as the estimate does, also where there are two units (Rao and Wu, "Resampling inference with complex
survey data", JASA 1988). The ends are percentiles of the draws, moved out for few units as Student's t is wider than a
normal distribution (Hesterberg, "What teachers should know about the bootstrap", The American Statistician 2015).
Trainings and maps cross, as all trainings play the same maps. Their spreads then add, less that of episodes, which is
in both (Cameron, Gelbach and Miller, "Robust inference with multiway clustering", JBES 2011). No interval is narrower
than that of any of its levels, and each holds its estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import stats

CHUNK = 4_000_000
"""Weights at a time: resamples x episodes."""


@dataclass(frozen=True)
class Interval:
    """An estimate with the ends of its interval.

    Both ends are None where nothing can be resampled, as of a single episode. Ends that are equal say that nothing
    varied, and are written down (`as_dict`) only of agents without chance on maps that come again (`Chance.repeats`).
    """

    mean: float
    low: float | None
    high: float | None

    def as_dict(self, repeats: bool = False) -> dict[str, float | None]:
        """`{"mean", "low", "high"}`, for files and tables: the ends are None where there is no interval.

        `repeats`: equal ends count, as an agent without chance has met every map more than once.
        """
        return asdict(self) if repeats or self.low != self.high else {"mean": self.mean, "low": None, "high": None}


class Level(NamedTuple):
    """One level of chance, resampled.

    Attributes:
        units: int [n], which unit each episode is in, 0 to k - 1.
        weights: float64 [R, k], of the units in each resample.
        degrees: of freedom, units less strata.
    """

    units: np.ndarray
    weights: np.ndarray
    degrees: int


class Spread(NamedTuple):
    """How far estimates [m] stray, by all levels of chance together: below and above, and their variance; float [m]."""

    below: np.ndarray
    above: np.ndarray
    variance: np.ndarray


class Chance:
    """The levels of chance of n episodes, resampled once for all that is measured of them."""

    def __init__(
        self,
        count: int,
        trainings: np.ndarray | None = None,
        maps: np.ndarray | None = None,
        strata: np.ndarray | None = None,
        confidence: float = 0.95,
        resamples: int = 2000,
        seed: int = 0,
    ) -> None:
        """Say what is chance.

        Args:
            count: episodes, n.
            trainings: labels [n]; None where nothing was trained.
            maps: labels [n], where maps are a sample; None where they are fixed.
            strata: labels [n] of what episodes are resampled within; None for all together.
            confidence: coverage.
            resamples: R.
            seed: of the resampling.
        """
        self.count, self.confidence, self.resamples, self.seed = count, confidence, resamples, seed
        self.levels = {"episodes": self._level(np.arange(count), strata)}
        for name, labels in (("trainings", trainings), ("maps", maps)):
            if labels is not None and len(np.unique(labels)) > 1:
                self.levels[name] = self._level(labels)

    def means(
        self, columns: Mapping[str, np.ndarray], shares: bool = True, explained: np.ndarray | None = None
    ) -> dict[str, Interval]:
        """Means of measures, float [n] each, NaN where an episode has none; no column is NaN throughout.

        Shares (columns of 0 and 1) always have an interval of some width, if they are to be told apart: no narrower
        than Wilson's for as many independent episodes as the variance is worth. `explained` [n], 0 on average, is the
        part of every measure that is no chance.
        """
        values = np.stack(list(columns.values()), axis=1).astype(np.float64)
        known = ~np.isnan(values)
        filled = np.where(known, values if explained is None else values - explained[:, None], 0.0)
        point = np.where(known, values, 0.0).sum(0) / known.sum(0)

        def draws(level: Level) -> np.ndarray:
            sums, counts = (_by_unit(part, level) for part in (filled, known.astype(np.float64)))
            with np.errstate(invalid="ignore"):  # a resample may hold no episode with a rare measure
                return np.asarray((level.weights @ sums) / (level.weights @ counts))

        spread = self._spread(point, draws)
        found = {}
        for at, name in enumerate(columns):
            mean, here = float(point[at]), values[known[:, at], at]
            low, high = mean - float(spread.below[at]), mean + float(spread.above[at])
            if shares and np.isin(here, (0.0, 1.0)).all():
                share = share_interval(mean, float(spread.variance[at]), len(here), self.confidence)
                found[name] = Interval(mean, max(min(low, share[0]), 0.0), min(max(high, share[1]), 1.0))
            else:
                found[name] = Interval(mean, low, high) if self.varies else Interval(mean, None, None)
        return found

    def mean(self, values: np.ndarray, shares: bool = True, explained: np.ndarray | None = None) -> Interval:
        """Mean of one measure, float [n]."""
        return self.means({"": values}, shares, explained)[""]

    def interquartile_mean(self, values: np.ndarray) -> Interval:
        """Mean of the middle half of `values` [n]; where resampling does not move it, with the interval of the mean."""
        values = np.asarray(values, np.float64)
        point = np.array([interquartile_mean(values)])

        def draws(level: Level) -> np.ndarray:
            rows = max(CHUNK // self.count, 1)
            parts = [level.weights[at : at + rows] for at in range(0, len(level.weights), rows)]
            return np.concatenate([interquartile_mean(values, part[:, level.units]) for part in parts])[:, None]

        spread = self._spread(point, draws)
        middle = float(point[0])
        low, high = middle - float(spread.below[0]), middle + float(spread.above[0])
        if low == high:
            mean = self.mean(values)
            if mean.low is None or mean.high is None:
                return Interval(middle, None, None)
            low, high = min(low, mean.low), max(high, mean.high)
        return Interval(middle, low, high)

    @cached_property
    def varies(self) -> bool:
        """Whether there is anything to resample."""
        return any(level.degrees > 0 for level in self.levels.values())

    @cached_property
    def repeats(self) -> bool:
        """Whether fixed maps, two or more, have been played several times each, and nothing else is chance."""
        episodes = self.levels["episodes"]
        return len(self.levels) == 1 and 0 < episodes.degrees < self.count - 1

    @cached_property
    def resampled(self) -> dict[str, int]:
        """How many units of each level there are."""
        return {name: level.weights.shape[1] for name, level in self.levels.items()}

    def _level(self, labels: np.ndarray, strata: np.ndarray | None = None) -> Level:
        """A level with units by `labels` [n], resampled within `strata` [n], each episode its own unit there."""
        rng = np.random.default_rng(self.seed)
        _, units = np.unique(labels, return_inverse=True)
        count = int(units.max()) + 1
        _, stratum, sizes = np.unique(
            np.zeros(count) if strata is None else strata, return_inverse=True, return_counts=True
        )
        weights = np.ones((self.resamples, count))
        for s, size in enumerate(sizes):
            if size > 1:
                weights[:, stratum == s] = drawn(rng, int(size), self.resamples)
        return Level(units, weights, int(count - len(sizes)))

    def _spread(self, point: np.ndarray, draws: Callable[[Level], np.ndarray]) -> Spread:
        """The spread of estimates [m], of which a level's resamples are `draws`, [R, m]."""
        found = {name: self._spread_of(point, draws(level), level.degrees) for name, level in self.levels.items()}
        parts = list(found.values())
        if len(found) == 3:
            single = found["episodes"]
            both = (
                np.sqrt(np.maximum(one**2 + other**2 - least**2, 0.0)) if at < 2 else one + other - least
                for at, (one, other, least) in enumerate(zip(found["trainings"], found["maps"], single, strict=True))
            )
            parts.append(Spread(*both))
        return Spread(*(np.max(sides, axis=0) for sides in zip(*parts, strict=True)))

    def _spread_of(self, point: np.ndarray, draws: np.ndarray, degrees: int) -> Spread:
        if degrees < 1:
            nothing = np.zeros(len(point))
            return Spread(nothing, nothing, nothing)
        tail = stats.norm.cdf(stats.t.ppf((1.0 - self.confidence) / 2, degrees))
        low, high = np.nanquantile(draws, [tail, 1.0 - tail], axis=0)
        rounding = 1e-12 * np.nanmax(np.abs(draws), axis=0)
        below, above = (np.where(side > rounding, side, 0.0) for side in (point - low, high - point))
        return Spread(below, above, np.nanvar(draws, axis=0))


def interquartile_mean(values: np.ndarray, weights: np.ndarray | None = None, axis: int = -1) -> np.ndarray:
    """Mean of the middle half: without the least and the greatest quarter of the episodes, in whole episodes.

    Args:
        values: float [..., n].
        weights: float [R, n] of `values` [n] in each of R resamples; None for 1 each.
        axis: of the episodes, without weights.
    """
    if weights is None:
        return np.asarray(stats.trim_mean(values, proportiontocut=0.25, axis=axis))
    order = np.argsort(values, kind="stable")
    share = weights[:, order] / weights.sum(1, keepdims=True)
    cut = (len(values) // 4) / len(values)
    ends = np.clip(np.cumsum(share, axis=1), cut, 1.0 - cut)
    inside = np.diff(ends, axis=1, prepend=cut)
    return np.asarray((inside @ values[order]) / (1.0 - 2 * cut))


def share_interval(share: float, variance: float, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a share of `count` episodes that is estimated with some variance.

    Wilson's, for as many independent episodes as the variance is worth. Where the variance is 0, all that is known is
    how many episodes there were: the greatest probability with which each of them may come out otherwise and yet,
    with a probability of (1 - confidence) / 2, none does (Clopper and Pearson's interval where the share is 0 or 1).
    """
    if variance <= 1e-12:
        odd = 1.0 - ((1.0 - confidence) / 2) ** (1.0 / count)
        return share - odd * share, share + odd * (1.0 - share)
    z2 = float(stats.norm.ppf((1.0 + confidence) / 2)) ** 2
    worth = share * (1.0 - share) / variance
    centre = (share + z2 / (2 * worth)) / (1 + z2 / worth)
    half = np.sqrt(z2 * share * (1 - share) / worth + z2**2 / (4 * worth**2)) / (1 + z2 / worth)
    return min(float(centre - half), share), max(float(centre + half), share)


def drawn(rng: np.random.Generator, count: int, resamples: int) -> np.ndarray:
    """Weights of `count` units in each resample of `count` - 1 of them, 1 on average: float64 [resamples, count]."""
    if count < 2:
        return np.ones((resamples, count))
    picked = rng.integers(count, size=(resamples, count - 1)) + count * np.arange(resamples)[:, None]
    return np.bincount(picked.reshape(-1), minlength=resamples * count).reshape(resamples, count) * (
        count / (count - 1)
    )


def _by_unit(values: np.ndarray, level: Level) -> np.ndarray:
    """Sums of `values` [n, m] over each unit: float64 [k, m]."""
    if level.weights.shape[1] == len(values):
        return values[np.argsort(level.units, kind="stable")]
    return np.stack([np.bincount(level.units, column, level.weights.shape[1]) for column in values.T], axis=1)
