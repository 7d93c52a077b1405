from __future__ import annotations

import numpy as np
import pytest

from planners.comparison.improvement import Played, improvement
from planners.comparison.statistics import (
    bootstrap,
    cluster_bootstrap,
    interquartile_mean,
    means_with_intervals,
    over_seeds,
    performance_profile,
    probability_of_improvement,
    running_average,
    stratified_bootstrap,
)


def test_interval_of_the_mean_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(200):
        interval = bootstrap(rng.normal(3.0, 1.0, 50), seed=trial, resamples=400)
        covered += interval.low <= 3.0 <= interval.high
    assert 0.88 <= covered / 200 <= 0.99


def test_intervals_repeat_and_degenerate_cases_are_exact() -> None:
    values = np.random.default_rng(1).random(30)
    assert bootstrap(values, seed=5) == bootstrap(values, seed=5)
    same = bootstrap(np.full(4, 2.0), seed=0)
    assert (same.mean, same.low, same.high) == (2.0, 2.0, 2.0)
    with pytest.raises(ValueError, match="at least one"):
        bootstrap(np.zeros(0), seed=0)


def test_stratified_interval_leaves_out_the_spread_between_groups() -> None:
    rng = np.random.default_rng(2)
    groups = np.repeat(np.arange(10), 20)
    values = groups * 10.0 + rng.normal(0, 1, 200)
    plain, stratified = bootstrap(values, 0), stratified_bootstrap(values, groups, 0)
    assert stratified.mean == pytest.approx(plain.mean)
    assert stratified.high - stratified.low < 0.1 * (plain.high - plain.low)


def test_robust_measures() -> None:
    assert interquartile_mean(np.array([-1000.0, 1.0, 2.0, 1000.0])) == 1.5
    assert performance_profile(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.5, 5.0])).tolist() == [1.0, 2 / 3, 0.0]
    better = probability_of_improvement(np.arange(10) + 100.0, np.arange(10.0), seed=0, resamples=50)
    assert better.mean == better.low == 1.0
    equal = probability_of_improvement(np.arange(10.0), np.arange(10.0), seed=0, resamples=50)
    assert equal.mean == 0.5


def test_running_averages_by_hand() -> None:
    values = np.array([1.0, 3.0, 5.0, 7.0])
    assert running_average(values).tolist() == [1.0, 2.0, 3.0, 4.0]
    assert running_average(values, 2).tolist() == [1.0, 2.0, 4.0, 6.0]


def test_improvement_is_counted_map_by_map() -> None:
    maps = np.repeat(np.arange(10), 4)
    worth = 100.0 * maps
    ours, theirs = Played(worth + 1.0, maps), Played(worth, maps)
    found, counted = improvement(ours, theirs, 0)
    assert (found.mean, found.low, found.high, counted) == (1.0, 1.0, 1.0, 10)
    assert probability_of_improvement(ours.returns, theirs.returns, 0).mean == pytest.approx(0.55)
    assert improvement(theirs, ours, 0)[0].mean == 0.0
    assert improvement(ours, ours, 0)[0].mean == 0.5
    fewer = improvement(ours, Played(theirs.returns[:20], maps[:20] + 5), 0)  # on maps 5 to 9 alone
    assert fewer[0].mean == 1.0
    assert fewer[1] == 5
    none = improvement(ours, Played(theirs.returns, maps + 100), 0)
    assert none[0].mean == pytest.approx(0.55)
    assert none[1] == 0


def test_improvement_resamples_what_is_uncertain() -> None:
    rng = np.random.default_rng(0)
    maps, luck = np.repeat(np.arange(20), 6), rng.normal(size=120)
    within, _ = improvement(Played(luck, maps), Played(rng.normal(size=120), maps), 0, resamples=2000)
    assert within.low < within.mean < within.high
    assert 0.03 < within.high - within.low < 0.3
    once, _ = improvement(Played(np.arange(20.0), np.arange(20)), Played(np.full(20, 4.5), np.arange(20)), 0)
    assert once.mean == 0.75
    assert once.low < 0.7 < 0.8 < once.high
    trainings = np.tile([0, 1, 2], 40)  # two of three trainings win everywhere
    over, _ = improvement(Played(np.where(trainings > 0, 1.0, -1.0), maps, trainings), Played(np.zeros(120), maps), 0)
    assert over.mean == pytest.approx(2 / 3)
    assert (over.low, over.high) == pytest.approx((0.0, 1.0))


def test_means_of_many_measures_have_the_intervals_of_each() -> None:
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(12), 5)
    values = groups + rng.normal(size=60)
    rare = np.where(np.arange(60) % 7 == 0, values, np.nan)
    found = means_with_intervals({"all": values, "rare": rare}, groups, False, 0, resamples=4000)
    alone = stratified_bootstrap(values, groups, 1, resamples=4000)
    assert found["all"].mean == pytest.approx(alone.mean)
    assert (found["all"].low, found["all"].high) == pytest.approx((alone.low, alone.high), abs=0.02)
    assert found["rare"].mean == pytest.approx(np.nanmean(rare))
    assert found["rare"].low < found["rare"].mean < found["rare"].high
    once = means_with_intervals({"all": values}, np.arange(60), False, 0, resamples=4000)["all"]
    plain = bootstrap(values, 1, resamples=4000)
    assert (once.low, once.high) == pytest.approx((plain.low, plain.high), abs=0.15)
    whole = means_with_intervals({"all": values}, groups, True, 0, resamples=4000)["all"]
    spread = over_seeds(values, groups, 1)
    assert (whole.mean, whole.low, whole.high) == pytest.approx((spread.mean, spread.low, spread.high), abs=0.15)


def test_improvement_counts_as_the_rank_test_does() -> None:
    from scipy import stats

    rng = np.random.default_rng(4)
    ours, theirs = rng.integers(0, 6, 30).astype(float), rng.integers(0, 6, 20).astype(float)
    expected = stats.mannwhitneyu(ours, theirs, alternative="greater").statistic / 600
    assert probability_of_improvement(ours, theirs, seed=0).mean == pytest.approx(expected)


def test_the_interval_over_seeds_is_that_of_their_means() -> None:
    seeds = np.repeat(np.arange(5), 100)
    values = np.random.default_rng(3).normal(0, 1, 500) + 10.0 * seeds
    between, pooled = over_seeds(values, seeds, 0), bootstrap(values, 0)
    assert between.mean == pytest.approx(pooled.mean)
    assert between.high - between.low > 3 * (pooled.high - pooled.low)


def test_repeats_of_a_map_say_nothing_about_other_maps() -> None:
    """A follower without chance played each of 84 maps three times: an interval of no width."""
    rng = np.random.default_rng(0)
    by_map = rng.normal(100.0, 20.0, 84)
    values, maps = np.tile(by_map, 3), np.tile(np.arange(84), 3)
    found = cluster_bootstrap(values, maps, 0)
    once = bootstrap(by_map, 0)
    assert (found.mean, found.low, found.high) == pytest.approx((once.mean, once.low, once.high))
    assert found.high - found.low > 5
    assert stratified_bootstrap(values, maps, 0).low == stratified_bootstrap(values, maps, 0).high
