"""What a comparison leaves in results/: one record per agent and condition, and tables and plots for papers.

episodes (all seeds pooled) -> records (means, interquartile means, intervals, regret, share of the optimum)
                            -> tables (planners.comparison.result_tables), statistics.json, plots

Intervals: over whole maps where there are more than anybody could play (those played are a sample); else stratified by
map where maps come more than once, since every agent meets the same ones; where each comes once, of what the optimum
there does not explain (a control variate); for agents that learn, with three seeds or more, over seeds, since the
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

from domains.core import Domain, DomainError
from nesy.run_folder import read_json, write_json
from planners.comparison.improvement import Played, improvement
from planners.comparison.statistics import (
    Interval,
    bootstrap,
    cluster_bootstrap,
    interquartile_mean,
    means_with_intervals,
    over_seeds,
    performance_profile,
    running_average,
    stratified_bootstrap,
)
from planners.config import ORACLES, PLANNING_AGENTS, CompareConfig

Optimum = dict[str, Any]
"""`mean_return`, `success`, and, where maps can be listed, `maps`: [{map_id, return, success}]."""
CONDITION = ("agent", "inputs", "influence", "variant")
METRICS_OF_NO_EPISODE = ("seed", "phase", "episode", "outcome", "map_id", "step", "experience_steps", *CONDITION)
MOST_POINTS = 400
"""Points of a stored learning curve."""


def write_results(
    folder: Path,
    episodes: pa.Table,
    config: CompareConfig,
    optima: dict[str, Optimum | None],
    left_out: dict[str, str] | None = None,
) -> list[dict[str, Any]]:
    """Sum up and write every table; returns the `comparison` list of summary.json.

    `left_out` says what has no episodes, and why.
    """
    from nesy.report.comparison_figures import save_figures
    from planners.comparison.result_tables import write_tables

    played = _groups(episodes, "eval")
    peers = {condition[3]: rows for condition, rows in played.items() if condition[0] == "optimum"}
    records = [
        _record(condition, rows, config, optima.get(condition[3]), peers.get(condition[3]))
        for condition, rows in played.items()
    ]
    regrets = [row for condition, rows in played.items() for row in _regrets(condition, rows, optima)]
    statistics = {
        "confidence": config.confidence,
        "left_out": left_out or {},
        "profiles": _profiles(played),
        "improvement": _improvements(played, config),
        "curves": [_curve(condition, rows, config) for condition, rows in _groups(episodes, "train").items()],
    }
    write_tables(folder, records, regrets)
    write_json(folder / "statistics.json", statistics)
    save_figures(folder / "plots", records, statistics)
    return records


def map_optimum(folder: Path, domain: Domain, variant: str) -> Optimum | None:
    """Return and success of the exact optimum, by map too; worked out once and kept. None where it is out of reach."""
    path = folder / f"optimum-{variant}.json"
    if path.is_file() and _is_optimum(kept := read_json(path)):
        return dict(kept)
    try:
        oracle = domain.optimum(variant)
        grids, _ = domain.maps(variant)
    except DomainError:
        return None
    maps = []
    if len(grids) == len(oracle.map_return):
        env: Any = domain.make("following", len(grids), variant=variant, seed=0, maps=grids, cycle=True)
        env.reset(seed=0)
        maps = [
            {"map_id": int(name), "return": float(value), "success": float(success)}
            for name, value, success in zip(env.map_ids(), oracle.map_return, oracle.map_success, strict=True)
        ]
        env.close()
    value = {"mean_return": oracle.mean_return, "success": oracle.success, "maps": maps}
    write_json(path, value)
    return value


def _is_optimum(value: Any) -> bool:
    """Whether a file holds what `map_optimum` writes; else it is worked out again."""
    return (
        isinstance(value, dict)
        and all(isinstance(value.get(key), int | float) for key in ("mean_return", "success"))
        and isinstance(value.get("maps"), list)
        and all(
            isinstance(entry, dict)
            and all(isinstance(entry.get(k), int | float) for k in ("map_id", "return", "success"))
            for entry in value["maps"]
        )
    )


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
) -> Interval:
    """Mean (or interquartile mean) of `values`.

    Args:
        values: float [n].
        rows: the episodes.
        config: has the coverage.
        robust: the interquartile mean.
        best: what the optimum gets in each of these episodes.
        sampled: whether the maps are a sample of many.
    """
    if _over_seeds(rows) and not robust:
        return over_seeds(values, rows["seed"], 0, config.confidence)
    statistic = interquartile_mean if robust else np.mean
    if sampled:
        return cluster_bootstrap(values, rows["map_id"], 0, config.confidence, statistic)
    if np.unique(rows["map_id"], return_counts=True)[1].min() >= 2:
        return stratified_bootstrap(values, rows["map_id"], 0, config.confidence, statistic)
    if best is None or robust:  # nothing to resample within a map
        return bootstrap(values, 0, config.confidence, statistic)
    return bootstrap(values - _explained(values, best), 0, config.confidence)


def _over_seeds(rows: dict[str, np.ndarray]) -> bool:
    """Whether these are several trainings. Planners' seeds are none: all plan with the same learned model."""
    learned = rows["experience_steps"].max() > 0 and rows["agent"][0] not in PLANNING_AGENTS
    return bool(learned and len(np.unique(rows["seed"])) >= 3)


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
) -> dict[str, Any]:
    returns, success = rows["return"], (rows["outcome"] == "success").astype(np.float64)
    sampled = optimum is None  # it is out of reach where there are too many maps
    best = _best(rows, optimum, peer, "return")
    mean_return = _interval(returns, rows, config, best=best, sampled=sampled).as_dict()
    best_success = _best(rows, optimum, peer, "success")
    mean_success = _interval(success, rows, config, best=best_success, sampled=sampled).as_dict()
    reference = optimum and optimum["mean_return"] if best is None else float(best.mean())
    record: dict[str, Any] = dict(zip(CONDITION, (str(part) for part in condition), strict=True))
    if record["agent"] == "optimum" and optimum is not None:
        mean_return, mean_success = _exact(optimum["mean_return"]), _exact(optimum["success"])
        reference = optimum["mean_return"]
    columns = {
        "steps" if name == "length" else name: column.astype(np.float64)
        for name, column in rows.items()
        if name not in METRICS_OF_NO_EPISODE and column.dtype.kind in "fi" and not np.isnan(column.astype(float)).all()
    }
    groups = rows["seed"] if _over_seeds(rows) else rows["map_id"]
    measured = means_with_intervals(columns, groups, sampled or _over_seeds(rows), 0, config.confidence)
    return {
        **record,
        "seeds": [int(seed) for seed in np.unique(rows["seed"])],
        "episodes": len(returns),
        "return": mean_return,
        "interquartile_mean": _interval(returns, rows, config, robust=True, sampled=sampled).as_dict(),
        "success": mean_success,
        "ms_per_decision": float(np.median(rows["ms_per_decision"])),
        "experience_steps": int(rows["experience_steps"].max()),
        "share_of_optimum": mean_return["mean"] / reference if reference else None,
        "regret": None if best is None else _interval(best - returns, rows, config).as_dict(),
        "metrics": {name: found.mean for name, found in measured.items()},
        "metric_intervals": {name: [found.low, found.high] for name, found in measured.items()},
    }


def _exact(value: float) -> dict[str, Any]:
    return {"mean": value, "low": None, "high": None}


def _best(
    rows: dict[str, np.ndarray], optimum: Optimum | None, peer: dict[str, np.ndarray] | None, what: str
) -> np.ndarray | None:
    """What the exact optimum gets in each episode: on its map, where that says enough, or else when it played the same.

    None where neither is known. `what` is `return` or `success`; `peer` holds the optimum's episodes.
    """
    known = _by_map(rows, optimum)
    if known is not None:
        return np.array([known[int(name)][what] for name in rows["map_id"]], np.float64)
    if peer is None:
        return None
    values = peer["return"] if what == "return" else peer["outcome"] == "success"
    same = dict(zip(zip(peer["seed"], peer["episode"], strict=True), values, strict=True))
    keys = list(zip(rows["seed"], rows["episode"], strict=True))
    return np.array([same[key] for key in keys], np.float64) if all(key in same for key in keys) else None


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


def _improvements(played: dict[tuple[str, ...], dict[str, np.ndarray]], config: CompareConfig) -> list[dict[str, Any]]:
    """P(an episode of the one beats one of the other on the same map) for every pair of conditions of one variant."""
    conditions = [key for key in played if key[0] not in ORACLES]
    episodes = {key: _played(played[key]) for key in conditions}
    found = []
    for ours, theirs in combinations(conditions, 2):
        if ours[3] == theirs[3]:
            p, maps = improvement(episodes[ours], episodes[theirs], 0, config.confidence)
            there = {"ours": _name(ours), "theirs": _name(theirs), "maps": maps, **p.as_dict()}
            back = {"mean": 1 - p.mean, "low": 1 - p.high, "high": 1 - p.low}
            found += [there, {"ours": _name(theirs), "theirs": _name(ours), "maps": maps, **back}]
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
        draws = np.random.default_rng(0).integers(len(seeds), size=(500, len(seeds)))
        means = lines[draws].mean(axis=1)
        tail = (1 - config.confidence) / 2
        low, high = np.quantile(means, [tail, 1 - tail], axis=0)
        curve[name] = {"mean": lines.mean(axis=0).tolist(), "low": low.tolist(), "high": high.tolist()}
    return curve
