"""What a comparison leaves in results/: one record per agent and condition, and tables and plots for papers.

episodes (all seeds pooled) -> records (means, interquartile means, intervals, regret, share of the optimum)
                            -> tables (planners.comparison.result_tables), statistics.json, plots

Where agents of a variant have played different numbers of episodes, records hold their figures twice: of all that an
agent has played, and, as `shared`, of the episodes that all have played, which tables and figures show.

Intervals (planners.comparison.chance): over maps where there are more than have been played (a sample then); else
within maps where they come more than once, since every agent meets the same ones; where each comes once, of what the
optimum there does not explain (a control variate); for agents that learn, with two seeds or more, over seeds, since the
episodes of one training have that training in common. Shares of the optimum are of what it gets in the same episodes:
on the same maps, or, where a map says too little (who knows which goal is meant), when it plays.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from nesy.run_folder import write_json
from planners.comparison.chance import Chance, Interval, drawn, share_interval
from planners.comparison.improvement import Played, improvement
from planners.comparison.optima import Optimum, is_optimum
from planners.comparison.statistics import performance_profile, running_average
from planners.config import ORACLES, PLANNING_AGENTS, REFERENCE_AGENTS, CompareConfig

CONDITION = ("agent", "inputs", "influence", "variant")
METRICS_OF_NO_EPISODE = (
    *CONDITION,
    *("seed", "phase", "episode", "outcome", "map_id", "step", "experience_steps", "algorithm", "model"),
)
MOST_POINTS = 400
"""Points of a stored learning curve."""


def write_results(
    folder: Path,
    episodes: pa.Table,
    config: CompareConfig,
    optima: dict[str, Optimum | None],
    left_out: dict[str, str] | None = None,
    maps: dict[str, int] | None = None,
) -> list[dict[str, Any]]:
    """Sum up and write every table; returns the `comparison` list of summary.json.

    Args:
        folder: of the results.
        episodes: all of them, as results/episodes.parquet has them.
        config: of the comparison.
        optima: by variant, as of `map_optimum`.
        left_out: what has no episodes, and why.
        maps: by variant, as of `count_maps`.
    """
    from nesy.report.comparison_figures import save_figures
    from planners.comparison.result_tables import write_tables

    played = _groups(episodes, "eval")
    shared, counted = _shared(played), maps or {}
    peers = {(condition[0], condition[3]): rows for condition, rows in played.items() if condition[0] in ORACLES}
    records = []
    for condition, rows in played.items():
        variant = condition[3]
        optimum, bayes = peers.get(("optimum", variant)), peers.get(("bayes-optimum", variant))
        theirs = (optima.get(variant), optimum, bayes, counted.get(variant), shared.get(condition))
        records.append(_record(condition, rows, config, *theirs))
    regrets = [row for condition, rows in played.items() for row in _regrets(condition, rows, optima)]
    statistics = {
        "confidence": config.confidence,
        "left_out": left_out or {},
        "profiles": _profiles(played | shared),
        "improvement": _improvements(played | shared, config, optima, counted),
        "curves": [_curve(condition, rows, config) for condition, rows in _groups(episodes, "train").items()],
    }
    write_tables(folder, records, regrets)
    write_json(folder / "statistics.json", statistics)
    save_figures(folder / "plots", records, statistics)
    return records


def _groups(episodes: pa.Table, phase: str) -> dict[tuple[str, ...], dict[str, np.ndarray]]:
    """Rows of one phase by condition, in the order of the table, as columns."""
    rows = episodes.filter(pa.compute.equal(episodes["phase"], phase))
    columns = {name: rows[name].to_numpy() for name in rows.column_names}
    keys = list(zip(*(columns[name] for name in CONDITION), strict=True))
    groups: dict[tuple[str, ...], list[int]] = {}
    for position, key in enumerate(keys):
        groups.setdefault(tuple(key), []).append(position)
    return {key: {name: column[rows] for name, column in columns.items()} for key, rows in groups.items()}


def _interval(
    values: np.ndarray,
    rows: dict[str, np.ndarray],
    config: CompareConfig,
    robust: bool = False,
    best: np.ndarray | None = None,
    sampled: bool = False,
    chance: Chance | None = None,
) -> Interval:
    """Mean (or interquartile mean) of `values`.

    Args:
        values: float [n].
        rows: the episodes.
        config: has the coverage.
        robust: the interquartile mean.
        best: what the optimum gets in each of these episodes.
        sampled: whether the maps are a sample of many.
        chance: of these rows, where it has been resampled already.
    """
    chance = chance or _chance(rows, config, sampled)
    if robust:
        return chance.interquartile_mean(values)
    once = not sampled and _strata(rows) is None  # nothing to resample within a map
    return chance.mean(values, explained=_explained(values, best) if once and best is not None else None)


def _chance(rows: dict[str, np.ndarray], config: CompareConfig, sampled: bool) -> Chance:
    """What is chance in these episodes; `sampled`: whether their maps are a sample of many."""
    trainings = rows["seed"] if _over_seeds(rows) else None
    maps, strata = (rows["map_id"], None) if sampled else (None, _strata(rows))
    return Chance(len(rows["map_id"]), trainings, maps, strata, config.confidence)


def _strata(rows: dict[str, np.ndarray]) -> np.ndarray | None:
    """The maps, where each has been played more than once."""
    return rows["map_id"] if np.unique(rows["map_id"], return_counts=True)[1].min() > 1 else None


def _sampled(rows: dict[str, np.ndarray], optimum: Optimum | None, maps: int | None) -> bool:
    """Whether there are more maps than have been played: of `maps`, or, where nobody says how many, by the optimum,
    which lists them, and is out of reach where there are too many.
    """  # noqa: D205
    if maps is None and (optimum is None or not optimum["maps"]):
        return optimum is None
    return len(np.unique(rows["map_id"])) < (len(optimum["maps"]) if maps is None and optimum else maps or np.inf)


def _over_seeds(rows: dict[str, np.ndarray]) -> bool:
    """Whether these are several trainings. Planners' seeds are none: all plan with the same learned model."""
    learned = rows["experience_steps"].max() > 0 and rows["agent"][0] not in PLANNING_AGENTS
    return bool(learned and len(np.unique(rows["seed"])) > 1)


def _explained(values: np.ndarray, best: np.ndarray) -> np.ndarray:
    """What of each episode's value is due to its map: a control variate, the optimum there, whose mean is known."""
    deviation = best - best.mean()
    spread = float(deviation @ deviation)
    slope = np.clip(deviation @ values / spread, 0.0, 1.0) if spread else 0.0
    return np.asarray(slope * deviation)


def _record(
    condition: tuple[str, ...],
    rows: dict[str, np.ndarray],
    config: CompareConfig,
    optimum: Optimum | None,
    peer: dict[str, np.ndarray] | None,
    bayes: dict[str, np.ndarray] | None = None,
    maps: int | None = None,
    shared: dict[str, np.ndarray] | None = None,
) -> dict[str, Any]:
    """One record.

    Args:
        condition: agent, inputs, influence, variant.
        rows: its episodes.
        config: of the comparison.
        optimum: exact, as of `map_optimum`.
        peer: the optimum's own episodes.
        bayes: those of the Bayes optimum.
        maps: how many there are, 0 for too many to be listed; None where nobody says.
        shared: those of the rows that every agent of the variant has played, where some have played others.
    """
    optimum = optimum if optimum is not None and is_optimum(optimum) else None
    record: dict[str, Any] = dict(zip(CONDITION, (str(part) for part in condition), strict=True))
    exact = optimum if record["agent"] == "optimum" and not config.rules else None
    record |= _figures(rows, config, optimum, peer, bayes, maps, exact is not None)
    record |= {name: str(rows[name][0]) for name in ("algorithm", "model") if name in rows}
    record["experience_steps"] = int(rows["experience_steps"].max())
    if exact is not None:
        record["exact"] = {"return": exact["mean_return"], "success": exact["success"]}
    if shared is not None:
        record["shared"] = _figures(shared, config, optimum, peer, bayes, maps, exact is not None)
    return record


def _figures(
    rows: dict[str, np.ndarray],
    config: CompareConfig,
    optimum: Optimum | None,
    peer: dict[str, np.ndarray] | None,
    bayes: dict[str, np.ndarray] | None,
    maps: int | None,
    exact: bool,
) -> dict[str, Any]:
    """Everything that is summed up of some episodes; `exact`: they are the optimum's, whose means are known by map."""
    sampled = _sampled(rows, optimum, maps)
    chance = _chance(rows, config, sampled)
    alike = chance.repeats and rows["agent"][0] in REFERENCE_AGENTS and rows["agent"][0] != "random"

    def mean(values: np.ndarray, best: np.ndarray | None = None, robust: bool = False) -> dict[str, Any]:
        return _interval(values, rows, config, robust, best, sampled, chance).as_dict(alike)

    returns, success = rows["return"], (rows["outcome"] == "success").astype(np.float64)
    best, best_success = (_best(rows, optimum, peer, what) for what in ("return", "success"))
    mean_return, mean_success = mean(returns, best), mean(success, best_success)
    if exact and best is not None and best_success is not None and _by_map(rows, optimum) is not None:
        mean_return, mean_success = _exact(best.mean()), _exact(best_success.mean())
    reference = optimum and optimum["mean_return"] if best is None else float(best.mean())
    columns = {
        "steps" if name == "length" else name: column.astype(np.float64)
        for name, column in rows.items()
        if name not in METRICS_OF_NO_EPISODE and column.dtype.kind in "fi" and not np.isnan(column.astype(float)).all()
    }
    measured = {name: found.as_dict(alike) for name, found in chance.means(columns).items()}
    bayes_return = None if bayes is None or bayes["agent"][0] == rows["agent"][0] else _same(rows, bayes, "return")
    return {
        "seeds": [int(seed) for seed in np.unique(rows["seed"])],
        "episodes": len(returns),
        "resampled": chance.resampled,
        "return": mean_return,
        "interquartile_mean": mean(returns, robust=True),
        "success": mean_success,
        "ms_per_decision": float(np.median(rows["ms_per_decision"])),
        "share_of_optimum": mean_return["mean"] / reference if reference and reference > 0 else None,
        "regret": None if best is None else mean(np.round(best - returns, 9)),
        "behind_bayes_optimum": None if bayes_return is None else mean(np.round(bayes_return - returns, 9)),
        "metrics": {name: found["mean"] for name, found in measured.items()},
        "metric_intervals": {name: [found["low"], found["high"]] for name, found in measured.items()},
    }


def _exact(value: float) -> dict[str, Any]:
    return {"mean": float(value), "low": None, "high": None, "exact": True}


def _best(
    rows: dict[str, np.ndarray], optimum: Optimum | None, peer: dict[str, np.ndarray] | None, what: str
) -> np.ndarray | None:
    """What the exact optimum gets in each episode: on its map, where that says enough, or else when it played the same.

    None where neither is known. `what` is `return` or `success`; `peer` holds the optimum's episodes.
    """
    known = _by_map(rows, optimum)
    if known is not None:
        return np.array([known[int(name)][what] for name in rows["map_id"]], np.float64)
    return None if peer is None else _same(rows, peer, what)


def _same(rows: dict[str, np.ndarray], peer: dict[str, np.ndarray], what: str) -> np.ndarray | None:
    """`return` or `success` of a peer in each of these episodes; None where it has not played all of them."""
    values = peer["return"] if what == "return" else peer["outcome"] == "success"
    same = dict(zip(_keys(peer), values, strict=True))
    keys = _keys(rows)
    return np.array([same[key] for key in keys], np.float64) if all(key in same for key in keys) else None


def _keys(rows: dict[str, np.ndarray]) -> list[tuple[int, ...]]:
    """What tells the episodes of a variant apart, whoever plays them: they start alike and run on the same chance."""
    return list(zip(*(rows[name].tolist() for name in ("seed", "episode", "map_id")), strict=True))


def _shared(played: dict[tuple[str, ...], dict[str, np.ndarray]]) -> dict[tuple[str, ...], dict[str, np.ndarray]]:
    """Of every condition the episodes that all agents of its variant have played, where some have played others."""
    found = {}
    for variant in {condition[3] for condition in played}:
        keys = {condition: _keys(rows) for condition, rows in played.items() if condition[3] == variant}
        common = set.intersection(*map(set, keys.values()))
        if common and any(len(own) > len(common) for own in keys.values()):
            for condition, own in keys.items():
                here = np.array([key in common for key in own])
                found[condition] = {name: column[here] for name, column in played[condition].items()}
    return found


def _by_map(rows: dict[str, np.ndarray], optimum: Optimum | None) -> dict[int, dict[str, Any]] | None:
    """The optimum's entry of each map; None where a map of these episodes has none."""
    known = {} if optimum is None else {entry["map_id"]: entry for entry in optimum["maps"]}
    return known if known and all(int(name) in known for name in rows["map_id"]) else None


def _regrets(
    condition: tuple[str, ...], rows: dict[str, np.ndarray], optima: dict[str, Optimum | None]
) -> list[dict[str, Any]]:
    """One row per map: what the condition got, and the optimum."""
    optimum = optima.get(rows["variant"][0])
    if optimum is None or _by_map(rows, optimum) is None:
        return []
    found = []
    for entry in optimum["maps"]:
        here = rows["map_id"] == entry["map_id"]
        if here.any():
            mean = float(rows["return"][here].mean())
            found.append(
                {
                    **dict(zip(CONDITION, (str(part) for part in condition), strict=True)),
                    "map_id": entry["map_id"],
                    "episodes": int(here.sum()),
                    "return": mean,
                    "success": float((rows["outcome"][here] == "success").mean()),
                    "optimum_return": entry["return"],
                    "optimum_success": entry["success"],
                    "regret": entry["return"] - mean,
                    "share": mean / entry["return"] if entry["return"] > 0 else None,
                }
            )
    return found


def _name(condition: Sequence[str]) -> str:
    return " / ".join(str(part) for part in condition if part)


def _profiles(played: dict[tuple[str, ...], dict[str, np.ndarray]]) -> dict[str, Any]:
    """Per condition the share of episodes with a return above each threshold."""
    everything = np.concatenate([rows["return"] for rows in played.values()])
    thresholds = np.linspace(everything.min(), everything.max(), 101)
    return {
        "thresholds": thresholds.tolist(),
        "shares": {
            _name(key): performance_profile(rows["return"], thresholds).tolist() for key, rows in played.items()
        },
        "episodes": {_name(key): len(rows["return"]) for key, rows in played.items()},
        "seeds": {_name(key): len(np.unique(rows["seed"])) for key, rows in played.items()},
    }


def _improvements(
    played: dict[tuple[str, ...], dict[str, np.ndarray]],
    config: CompareConfig,
    optima: dict[str, Optimum | None],
    maps: dict[str, int],
) -> list[dict[str, Any]]:
    """P(an episode of the one beats one of the other on the same map) for every pair of conditions of one variant."""
    conditions = [key for key in played if key[0] not in ORACLES]
    episodes = {key: _played(played[key]) for key in conditions}
    found = []
    for ours, theirs in combinations(conditions, 2):
        if ours[3] == theirs[3]:
            sampled = _sampled(played[ours], optima.get(ours[3]), maps.get(ours[3]))
            p, common = improvement(episodes[ours], episodes[theirs], 0, config.confidence, sampled=sampled)
            low, high = p.low, p.high
            if low == high:  # of a share there is always an interval
                fewer = min(len(episodes[key].returns) for key in (ours, theirs))
                low, high = share_interval(p.mean, 0.0, fewer, config.confidence)
            assert low is not None and high is not None
            there = {"ours": _name(ours), "theirs": _name(theirs), "maps": common}
            there |= {"mean": p.mean, "low": low, "high": high}
            back = {"mean": 1 - p.mean, "low": 1 - high, "high": 1 - low}
            found += [there, {"ours": _name(theirs), "theirs": _name(ours), "maps": common, **back}]
    order = {_name(key): at for at, key in enumerate(conditions)}
    return sorted(found, key=lambda pair: (order[pair["ours"]], order[pair["theirs"]]))


def _played(rows: dict[str, np.ndarray]) -> Played:
    return Played(rows["return"], rows["map_id"], rows["seed"] if _over_seeds(rows) else None)


def _curve(condition: tuple[str, ...], rows: dict[str, np.ndarray], config: CompareConfig) -> dict[str, Any]:
    """A learning curve with its band over seeds: of the policy (mean of the last 200 episodes, or a fiftieth of all)
    and of the running average over all episodes so far.
    """  # noqa: D205
    seeds = np.unique(rows["seed"])
    per_seed = [rows["return"][rows["seed"] == seed] for seed in seeds]
    length = min(len(returns) for returns in per_seed)
    window = min(200, max(length // 50, 1))
    at = np.unique(np.linspace(window - 1, length - 1, min(MOST_POINTS, length)).astype(int))
    curve: dict[str, Any] = {"name": _name(condition), "variant": condition[3]}
    curve |= {"seeds": len(seeds), "episodes": length, "window": window}
    curve["episode"] = (at + 1).tolist()
    steps = [rows["step"][rows["seed"] == seed] for seed in seeds]
    curve["steps"] = np.mean([taken[at] for taken in steps], axis=0).tolist()
    for name, width in (("policy", window), ("running_average", None)):
        lines = np.array([running_average(returns[:length], width)[at] for returns in per_seed])
        curve[name] = {"mean": lines.mean(axis=0).tolist(), "low": None, "high": None}
        if len(seeds) > 1:
            means = drawn(np.random.default_rng(0), len(seeds), 500) @ lines / len(seeds)
            tail = (1 - config.confidence) / 2
            low, high = np.quantile(means, [tail, 1 - tail], axis=0)
            curve[name] |= {"low": low.tolist(), "high": high.tolist()}
    return curve
