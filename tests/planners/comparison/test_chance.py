"""Intervals hold their estimate, have width where there is chance, and cover as often as they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from planners.comparison.chance import Chance, Interval, drawn, interquartile_mean, share_interval
from planners.comparison.results import _improvements, _record, _shared
from planners.config import CompareConfig

CONFIG = CompareConfig()
CONDITION = ("dqn", "full", "zero", "v")


def _rows(returns: np.ndarray, seeds: np.ndarray, maps: np.ndarray, agent: str = "dqn") -> dict[str, Any]:
    """Episodes as results have them; those with a positive return succeed."""
    count = len(returns)
    episode = np.concatenate([np.arange(np.count_nonzero(seeds == seed)) for seed in np.unique(seeds)])
    return {
        "agent": np.full(count, agent),
        "seed": seeds,
        "episode": episode,
        "map_id": maps,
        "return": np.asarray(returns, np.float64),
        "outcome": np.where(np.asarray(returns) > 0, "success", "lost"),
        "length": np.full(count, 5),
        "experience_steps": np.full(count, 1000 if agent == "dqn" else 0),
        "ms_per_decision": np.ones(count),
    }


def _width(figure: dict[str, Any]) -> float:
    assert figure["low"] <= figure["mean"] <= figure["high"], figure
    return float(figure["high"] - figure["low"])


@given(
    seeds=st.integers(1, 4),
    maps=st.integers(1, 6),
    repeats=st.integers(1, 3),
    values=st.sampled_from(["equal", "by seed", "by map", "noise", "shares", "one odd"]),
    oracle=st.sampled_from(["none", "maps", "mean alone", "not a number"]),
    agent=st.sampled_from(["dqn", "search", "random"]),
    draw=st.integers(0, 10_000),
)
@settings(max_examples=120, deadline=None)
def test_every_interval_holds_its_estimate_and_has_a_width(
    seeds: int, maps: int, repeats: int, values: str, oracle: str, agent: str, draw: int
) -> None:
    rng = np.random.default_rng(draw)
    seed, map_id = np.repeat(np.arange(seeds), maps * repeats), np.tile(np.arange(maps), seeds * repeats)
    count = len(seed)
    returns = {
        "equal": np.full(count, 7.5),
        "by seed": 10.0 * seed,
        "by map": 1e6 * map_id,
        "noise": rng.normal(0, 1e-3, count),
        "shares": (rng.random(count) < 0.3).astype(float),
        "one odd": (np.arange(count) == count - 1) * 100.0,
    }[values]
    entries = [{"map_id": m, "return": 9.0 * m, "success": 1.0} for m in range(maps)]
    optimum = {
        "none": None,
        "maps": {"mean_return": 4.5 * (maps - 1), "success": 1.0, "maps": entries},
        "mean alone": {"mean_return": 5.0, "success": 1.0, "maps": []},
        "not a number": {"mean_return": float("nan"), "success": 1.0, "maps": []},
    }[oracle]
    record = _record(CONDITION, _rows(returns, seed, map_id, agent), CONFIG, optimum, None)
    shown = [record["return"], record["interquartile_mean"], record["success"], record["regret"] or {"low": None}]
    shown += [
        {"mean": record["metrics"][name], "low": low, "high": high}
        for name, (low, high) in record["metric_intervals"].items()
    ]
    for figure in shown:
        if figure["low"] is not None:
            assert _width(figure) > 0
    assert 0 <= record["success"]["low"] < record["success"]["high"] <= 1  # a share always has one
    if count > 1 and np.ptp(returns) > 0 and oracle != "maps":  # else the maps may explain everything
        fixed = oracle == "mean alone" and maps > 1 and len(np.unique(seed)) * repeats > 1
        within = any(np.ptp(returns[map_id == m]) > 0 for m in range(maps))
        assert record["return"]["low"] is not None or (fixed and not within)
    assert record["share_of_optimum"] is None or np.isfinite(record["share_of_optimum"])


def test_one_episode_has_no_interval_and_says_so() -> None:
    record = _record(CONDITION, _rows(np.array([112.1]), np.zeros(1), np.zeros(1)), CONFIG, None, None)
    assert record["return"] == {"mean": 112.1, "low": None, "high": None}
    assert record["interquartile_mean"] == record["return"]
    assert record["success"]["low"] == pytest.approx(0.025) and record["success"]["high"] == 1.0


@pytest.mark.parametrize("wins", [0, 1, 19, 50, 100])
def test_shares_of_one_map_without_an_oracle(wins: int) -> None:
    """Nothing to resample but episodes: intervals as of a binomial share."""
    returns = (np.arange(100) < wins).astype(float)
    record = _record(CONDITION, _rows(returns, np.zeros(100), np.zeros(100)), CONFIG, None, None)
    exact = stats.binomtest(wins, 100).proportion_ci(method="exact")
    assert record["return"] == record["success"]
    assert record["success"]["low"] == pytest.approx(exact.low, abs=0.025)
    assert record["success"]["high"] == pytest.approx(exact.high, abs=0.025)
    middle = record["interquartile_mean"]
    assert _width(middle) > 0
    assert middle["mean"] == pytest.approx(np.clip((wins / 100 - 0.25) / 0.5, 0, 1))


def test_a_share_without_a_single_exception_is_clopper_and_pearson_s() -> None:
    for share in (0.0, 1.0):
        exact = stats.binomtest(int(share * 40), 40).proportion_ci(method="exact")
        assert share_interval(share, 0.0, 40) == pytest.approx((exact.low, exact.high))
    wilson = stats.binomtest(19, 100).proportion_ci(method="wilson")
    assert share_interval(0.19, 0.19 * 0.81 / 100, 100) == pytest.approx((wilson.low, wilson.high))


def test_trainings_that_end_differently_are_resampled_for_every_statistic() -> None:
    rng = np.random.default_rng(0)
    seeds, maps = np.repeat(np.arange(5), 168), np.tile(np.arange(168) % 42, 5)
    returns = np.array([20.0, 40, 60, 80, 90])[seeds] + rng.normal(0, 1, 840)
    entries = [{"map_id": m, "return": 95.0, "success": 1.0} for m in range(42)]
    known = {"mean_return": 95.0, "success": 1.0, "maps": entries}
    for optimum in (known, None):
        record = _record(CONDITION, _rows(returns, seeds, maps), CONFIG, optimum, None)
        assert _width(record["return"]) > 40 and _width(record["interquartile_mean"]) > 40
        assert record["resampled"]["trainings"] == 5
    two = seeds < 2
    record = _record(CONDITION, _rows(returns[two], seeds[two], maps[two]), CONFIG, known, None)
    assert _width(record["return"]) > 15
    one = seeds < 1
    record = _record(CONDITION, _rows(returns[one], seeds[one], maps[one]), CONFIG, known, None)
    assert 0 < _width(record["return"]) < 1 and "trainings" not in record["resampled"]


def test_agents_without_chance_on_fixed_maps_may_have_intervals_of_no_width() -> None:
    """All maps played twice and each time alike: nothing is uncertain, but that is known of shares least of all."""
    maps = np.tile(np.arange(42), 2)
    for agent, seen in (("greedy-follower", True), ("search", False)):
        record = _record(CONDITION, _rows(10.0 * maps, np.zeros(84), maps, agent), CONFIG, None, None, maps=42)
        assert (record["return"]["low"] == record["return"]["mean"]) is seen
        assert 0 < _width(record["success"]) < 0.1
    once = _record(CONDITION, _rows(10.0 * maps[:42], np.zeros(42), maps[:42]), CONFIG, None, None, maps=168)
    assert _width(once["return"]) > 50  # 42 of 168 maps: a sample


def test_trainings_that_end_alike_keep_the_chance_of_their_episodes() -> None:
    seeds, returns = np.repeat(np.arange(3), 50), np.tile(np.arange(50) % 2, 3).astype(float)
    record = _record(CONDITION, _rows(returns, seeds, np.zeros(150)), CONFIG, None, None)
    assert _width(record["return"]) == pytest.approx(2 * 1.96 * 0.5 / 150**0.5, rel=0.1)


def _coverage(chance: Any, trials: int = 300) -> float:
    covered = 0
    for trial in range(trials):
        found: Interval = chance(np.random.default_rng(trial))
        assert found.low is not None and found.high is not None
        covered += found.low <= 0.0 <= found.high
    return covered / trials


def test_coverage() -> None:
    def few(rng: np.random.Generator) -> Interval:
        return Chance(8, resamples=400).mean(rng.normal(size=8))

    def trainings(rng: np.random.Generator) -> Interval:
        seeds = np.repeat(np.arange(6), 20)
        return Chance(120, seeds, resamples=400).mean(rng.normal(size=6)[seeds] + rng.normal(size=120))

    def crossed(rng: np.random.Generator) -> Interval:
        seeds, maps = np.repeat(np.arange(8), 12), np.tile(np.arange(12), 8)
        values = rng.normal(size=8)[seeds] + rng.normal(size=12)[maps] + rng.normal(size=96)
        return Chance(96, seeds, maps, resamples=400).mean(values)

    def pairs(rng: np.random.Generator) -> Interval:
        maps = np.repeat(np.arange(20), 2)
        return Chance(40, strata=maps, resamples=400).mean(rng.normal(size=40))

    def middle(rng: np.random.Generator) -> Interval:
        return Chance(40, resamples=400).interquartile_mean(rng.standard_t(2, size=40))

    for setting in (few, trainings, crossed, pairs, middle):
        assert 0.9 <= _coverage(setting) <= 0.995, setting.__name__


@pytest.mark.parametrize("share", [0.03, 0.2, 0.5, 0.97])
def test_coverage_of_shares(share: float) -> None:
    def shares(rng: np.random.Generator) -> Interval:
        found = Chance(60, resamples=400).mean((rng.random(60) < share).astype(float))
        assert found.low is not None and found.high is not None
        return Interval(0.0, found.low - share, found.high - share)

    assert _coverage(shares) >= 0.92


def test_resamples_spread_as_the_estimate_does() -> None:
    for count in (2, 5, 40):
        weights = drawn(np.random.default_rng(0), count, 20_000)
        assert weights.mean(axis=1) == pytest.approx(1.0)
        values = np.random.default_rng(1).normal(size=count)
        assert (weights @ values / count).var() == pytest.approx(values.var(ddof=1) / count, rel=0.1)


def test_the_weighted_interquartile_mean_is_that_of_the_resample() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=21)
    weights = rng.multinomial(21, np.full(21, 1 / 21), 5).astype(float)
    expected = [float(interquartile_mean(np.repeat(values, row.astype(int)))) for row in weights]
    assert interquartile_mean(values, weights) == pytest.approx(expected)
    assert interquartile_mean(values, np.ones((1, 21)))[0] == pytest.approx(interquartile_mean(values))


def test_episodes_that_not_all_have_played_are_told_apart() -> None:
    def rows(agent: str, count: int) -> dict[str, Any]:
        return _rows(np.arange(count) - 3.0, np.zeros(count, int), np.arange(count) % 6, agent)

    played = {
        ("search", "full", "zero", "v"): rows("search", 6),
        ("random", "", "", "v"): rows("random", 12),
        ("random", "", "", "w"): rows("random", 9),
    }
    shared = _shared(played)
    assert set(shared) == {("search", "full", "zero", "v"), ("random", "", "", "v")}
    assert all(part["episode"].tolist() == list(range(6)) for part in shared.values())
    peer = rows("bayes-optimum", 12)
    peer["return"] = peer["return"] + 2.0
    condition = ("random", "", "", "v")
    record = _record(condition, played[condition], CONFIG, None, None, peer, 6, shared[condition])
    assert record["episodes"] == 12 and record["shared"]["episodes"] == 6
    assert record["shared"]["return"]["mean"] == pytest.approx(-0.5)
    assert record["behind_bayes_optimum"] == {"mean": 2.0, "low": None, "high": None}


def test_an_agent_that_always_wins_may_still_lose() -> None:
    maps = np.repeat(np.arange(10), 4)
    played = {
        (agent, "", "", "v"): _rows(maps + gain, np.zeros(40, int), maps, agent)
        for agent, gain in (("search", 1.0), ("random", 0.0))
    }
    better, worse = _improvements(played, CONFIG, {}, {"v": 10})
    assert better["mean"] == better["high"] == 1.0 and 0.9 < better["low"] < 1.0
    assert worse["mean"] == worse["low"] == 0.0 and 0.0 < worse["high"] < 0.1
    assert better["maps"] == 10
