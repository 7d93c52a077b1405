"""Every world of a variant where minds matter, played by planners, learners, followers, and exact oracles.

    python scripts/world_table.py --run runs/intent [--repeats 5] [--output minds.json] [--no-oracles]

A world is a map and the candidate that is the person's goal; all of them are played, so nothing is left to the draw of
worlds: what varies from repeat to repeat is the search's own chance. Each line has the mean return over all worlds,
weighted as they occur, with a 95 % interval over repeats (t), and, as if the worlds were a sample, one over worlds
(bootstrap); and its paired differences to `search` (2DBN and influence prior) and `structured` (hand-structured), both
with the perspective-shift prior, with the latter interval.
The run needs a comparison on its own variant (nesy run --variant intent), which leaves the tables and the policies.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from domains.core import load_domain
from nesy.cli.configuration import load
from nesy.perspective.influence import INFLUENCE_MODES
from nesy.run_folder import RunFolder, atomic_path
from planners.comparison.evaluation import Player
from planners.comparison.grid import Cell
from planners.comparison.model_store import ModelStore
from planners.comparison.players import build_player, restored_player
from planners.config import PLANNING_AGENTS

_RESAMPLES = 4000


def main() -> None:
    """Play what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--variant", help="by default that of the run")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--agents", nargs="+", choices=PLANNING_AGENTS, default=["search", "structured"])
    parser.add_argument("--modes", nargs="+", choices=INFLUENCE_MODES, default=list(INFLUENCE_MODES))
    parser.add_argument("--output", type=Path)
    parser.add_argument("--no-oracles", action="store_true", help="leave out what takes half a minute")
    arguments = parser.parse_args()
    run, domain = RunFolder.open(arguments.run), load_domain()
    config = load(run.config)
    variant = arguments.variant or config.variant
    structured = "structured" in arguments.agents
    ModelStore(run).learn(domain, variant, config.compare.search, config.seed, structured)
    grids, own, weights = worlds(domain, variant)
    rows: dict[str, dict[str, Any]] = {}

    def add(name: str, returns: np.ndarray, success: np.ndarray, milliseconds: float = 0.0) -> None:
        rows[name] = {
            "returns": returns.mean(0).tolist(),
            "repeats": (returns @ weights).tolist(),
            "success": float((success @ weights).mean()),
            "ms": milliseconds,
        }
        print(f"{name}: {rows[name]['repeats']}", flush=True)

    for agent in ("greedy-follower", "greedy-last-seen"):
        player = build_player(Cell(agent, "", "", variant, 0), run, domain, config.compare, 0).player
        add(agent, *play(domain, variant, player, grids, own))
    for path in sorted(run.policies.glob(f"dqn-full-*-{variant}-seed*.safetensors")):
        influence, seed = path.stem.removeprefix("dqn-full-").split(f"-{variant}-seed")
        cell = Cell("dqn", "full", influence, variant, int(seed))
        player = restored_player(cell, run, domain, config.compare, config.seed)
        add(f"dqn full, {influence}, seed {seed}", *play(domain, variant, player, grids, own))
    for agent, mode in itertools.product(arguments.agents, arguments.modes):
        played = []
        for repeat in range(arguments.repeats):
            player = build_player(Cell(agent, "full", mode, variant, 0), run, domain, config.compare, repeat).player
            played.append(play(domain, variant, player, grids, own))
        returns, success, milliseconds = (np.concatenate([np.atleast_2d(one[i]) for one in played]) for i in range(3))
        add(f"{agent}, {mode}", returns, success, float(np.median(milliseconds)))
    if not arguments.no_oracles:
        for name, solve in (
            ("optimum", domain.optimum),
            ("bayes-optimum", domain.bayes_optimum),
            ("egocentric-optimum", domain.egocentric_optimum),
        ):
            found = solve(variant)
            add(name, found.map_return[None], found.map_success[None])
    print(table(rows, weights))
    if arguments.output is not None:
        with atomic_path(arguments.output) as temporary:
            temporary.write_text(json.dumps({"variant": variant, "weights": weights.tolist(), "rows": rows}))


def worlds(domain: Any, variant: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maps [W, size, size], the candidate that is the goal [W], probabilities [W]."""
    grids, weights = domain.maps(variant)
    candidates = int(domain.make("following", 1, variant=variant).parameters.num_goals)
    return (
        np.repeat(grids, candidates, axis=0),
        np.tile(np.arange(candidates), len(grids)),
        np.repeat(weights / candidates, candidates),
    )


def play(
    domain: Any, variant: str, player: Player, grids: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Every world once: returns [1, W], successes [1, W], milliseconds per decision."""
    count = len(grids)
    env = domain.make("following", count, variant=variant, seed=0, maps=grids, cycle=True)
    env.reset(seed=0)
    env.batch.begin_worlds(grids, own)
    last = env.batch.last
    observation = {"view": last.robot_view.copy(), "configuration": last.configuration.copy()}
    active, returns, success = np.ones(count, np.bool_), np.zeros(count), np.zeros(count)
    before: np.ndarray | None = None
    spent, decisions = 0.0, 0
    while active.any():
        started = time.process_time()
        actions, _ = player.decide(env, observation, active, before)
        spent, decisions = spent + time.process_time() - started, decisions + int(active.sum())
        observation, reward, terminated, truncated, infos = env.step(actions)
        returns += np.where(active, reward, 0.0)
        ended = active & (np.asarray(terminated) | np.asarray(truncated))
        success[ended] = np.asarray(infos["outcome_code"])[ended] == 1
        active, before = active & ~ended, actions
    return returns[None], success[None], 1000.0 * spent / decisions


def table(rows: dict[str, dict[str, Any]], weights: np.ndarray) -> str:
    """The table in Markdown; shares of the gap are those between the follower with the full state and Bayes."""
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(weights), weights, size=_RESAMPLES) / len(weights)  # [resamples, W]
    low, high = (
        (float(np.mean(rows[name]["repeats"])) if name in rows else np.nan)
        for name in ("greedy-follower", "bayes-optimum")
    )
    lines = [
        "| agent | return | over repeats | over worlds | search, perspective-shift is better by | "
        "structured, perspective-shift is better by | success | gap closed | ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in sorted(rows.items(), key=lambda item: -float(np.mean(item[1]["repeats"]))):
        repeats, returns = np.array(row["repeats"]), np.array(row["returns"])
        mean = float(repeats.mean())
        half = (
            float(student.ppf(0.975, len(repeats) - 1) * repeats.std(ddof=1) / len(repeats) ** 0.5)
            if len(repeats) > 1
            else 0.0
        )
        cells = [f"{mean - half:.1f} to {mean + half:.1f}" if len(repeats) > 1 else "exact", _interval(drawn @ returns)]
        cells += [
            _better(rows, f"{agent}, perspective-shift", name, weights, drawn) for agent in ("search", "structured")
        ]
        closed = (mean - low) / (high - low)
        cells += [
            f"{row['success']:.3f}",
            f"{100 * closed:.0f} %" if np.isfinite(closed) else "",
            f"{row['ms']:.1f}" if row["ms"] else "",
        ]
        lines.append(f"| {name} | {mean:.1f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _better(rows: dict[str, dict[str, Any]], ours: str, theirs: str, weights: np.ndarray, drawn: np.ndarray) -> str:
    """By how much `ours` is better than `theirs` on the same worlds, with its interval over worlds."""
    if ours not in rows or ours == theirs:
        return ""
    ahead = np.array(rows[ours]["returns"]) - np.array(rows[theirs]["returns"])
    return f"{ahead @ weights:.1f} ({_interval(drawn @ ahead)})"


def _interval(values: np.ndarray) -> str:
    below, above = np.quantile(values, [0.025, 0.975])
    return f"{below:.1f} to {above:.1f}"


if __name__ == "__main__":
    main()
