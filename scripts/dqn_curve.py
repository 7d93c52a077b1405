"""How many episodes a belief DQN needs: return of its greedy policy against training episodes, beside the optimum.

    python scripts/dqn_curve.py --run runs/demo --output runs/dqn_curve --episodes 6000
    python scripts/dqn_curve.py --run runs/demo --output runs/dqn_curve --episodes 1500 --dqn.updates-per-step 0.5

The training stops now and then to let its policy play, without exploring, the maps of the variant; that changes
nothing of what is learned. Every call adds a curve (--label) to curves.json, and draws all that are there as
curves.png and curves.svg. A curve that is there already is not learned again.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from domains.core import load_domain
from nesy.report.comparison_figures import save
from nesy.report.text import interval
from nesy.run_folder import RunFolder, read_json, write_json
from planners.agents import DQNAgent
from planners.comparison.evaluation import Player, evaluate
from planners.comparison.grid import EVALUATION_SEED
from planners.comparison.optima import map_optimum
from planners.comparison.statistics import over_seeds
from planners.config import DQNConfig
from planners.dqn.dqn import Training
from planners.dqn.published import dqn_perception

WITHIN = 0.97


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """A run with a trained world model."""
    output: Path = Path("runs/dqn_curve")
    """Where the curves go."""
    label: str = ""
    """Name of the curve; by default what it is of."""
    variant: str = "paper"
    """Variant of the task."""
    inputs: str = "full"
    """Input set."""
    influence: str = "perspective-shift"
    """Influence mode."""
    episodes: int = 6000
    """Training episodes."""
    points: int = 20
    """Evaluations, evenly spread over the episodes."""
    played: int = 168
    """Episodes of each evaluation (`paper`: a multiple of its 42 maps)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    jobs: int = 1
    """Processes."""
    dqn: DQNConfig = field(default_factory=DQNConfig.fast)
    """How the DQN learns."""


def main(options: Arguments) -> None:
    """Learn the curve unless it is there, draw all curves, and print this one."""
    label = options.label or f"{options.inputs} / {options.influence} / {options.variant}, {options.episodes} episodes"
    path = options.output / "curves.json"
    curves: dict[str, Any] = read_json(path) if path.is_file() else {}
    if label not in curves:
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            per_seed = list(pool.map(partial(measure, options), options.seeds))
        options.output.mkdir(parents=True, exist_ok=True)
        optimum = map_optimum(options.output, load_domain(), options.variant)
        curves[label] = {
            "variant": options.variant,
            "optimum": None if optimum is None else optimum["mean_return"],
            "played": options.played,
            "seeds": list(options.seeds),
            "dqn": asdict(replace(options.dqn, episodes=options.episodes)),
            "per_seed": per_seed,
        }
        write_json(path, curves)
    draw(curves, options.output / "curves")
    print("\n".join(table(label, curves[label])))


def measure(options: Arguments, seed: int) -> list[dict[str, float]]:
    """One training: at every evaluation the episodes, steps, updates and seconds of learning so far, and the return."""
    from nesy.world_model import SymbolicCodec, load_world_model

    torch.set_num_threads(1)
    domain, codec = load_domain(), SymbolicCodec(load_world_model(RunFolder(options.run).world_model))
    config = replace(options.dqn, episodes=options.episodes)
    training = Training(domain, codec, options.inputs, options.influence, options.variant, config, seed)
    points: list[dict[str, float]] = []
    seconds = 0.0
    while len(points) < options.points:
        goal = options.episodes * (len(points) + 1) // options.points
        started = time.process_time()
        while len(training.finished) < goal:
            training.step(training.choose())
            training.learn()
        seconds += time.process_time() - started
        perception = dqn_perception(codec, options.influence, np.random.default_rng([seed, 1]), config)
        player = Player(DQNAgent(training.policy()), perception)
        columns = evaluate(domain, options.variant, player, options.played, EVALUATION_SEED + seed)
        points.append(
            {
                "episodes": goal,
                "steps": training.steps,
                "updates": training.updates,
                "seconds": seconds,
                "return": float(columns["return"].mean()),
            }
        )
    training.env.close()
    return points


def table(label: str, curve: dict[str, Any]) -> list[str]:
    """The curve as lines of Markdown, and from when on every later evaluation was near the optimum."""
    lines = [f"{label}; {curve['played']} episodes in each evaluation, seeds {curve['seeds']}", ""]
    lines += ["| episodes | steps | updates | seconds | return | of optimum |", "| --- |" + " --- |" * 5]
    optimum, seeds = curve["optimum"], np.array(curve["seeds"])
    for rows in zip(*curve["per_seed"], strict=True):
        value = over_seeds(np.array([row["return"] for row in rows]), seeds, 0)
        share = "" if optimum is None else f"{100 * value.mean / optimum:.1f} %"
        means = [float(np.mean([row[name] for row in rows])) for name in ("steps", "updates", "seconds")]
        lines.append(
            f"| {rows[0]['episodes']} | {means[0]:,.0f} | {means[1]:,.0f} | {means[2]:.0f} | "
            f"{interval(value.as_dict(), 1)} | {share} |"
        )
    if optimum is not None:
        arrived = [settled(rows, WITHIN * optimum) for rows in curve["per_seed"]]
        lines += ["", f"within 3 % of the optimum {optimum:.1f} from then on, per seed: {arrived} episodes"]
    return lines


def settled(rows: list[dict[str, float]], least: float) -> int | None:
    """The episodes after which no evaluation fell below `least`; None where the last one did."""
    found = None
    for row in rows:
        if row["return"] < least:
            found = None
        elif found is None:
            found = int(row["episodes"])
    return found


def draw(curves: dict[str, Any], path: Path) -> None:
    """All curves, with bands over seeds, and the optima as dotted lines."""
    from matplotlib.figure import Figure

    from nesy.report.figures import PALETTE

    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.subplots()
    for position, (label, curve) in enumerate(curves.items()):
        colour = PALETTE[position % len(PALETTE)]
        at = [row["episodes"] for row in curve["per_seed"][0]]
        values = np.array([[row["return"] for row in rows] for rows in curve["per_seed"]])
        counted = f"{len(values)} seed{'s' if len(values) > 1 else ''}, {curve['played']} episodes at each point"
        axes.plot(at, values.mean(axis=0), color=colour, label=f"{label} ({counted})")
        axes.fill_between(at, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.2, linewidth=0)
    for optimum in {curve["optimum"] for curve in curves.values()} - {None}:
        axes.axhline(optimum, color="#000000", linestyle=":", linewidth=1)
    axes.set_xlabel("training episodes (bands: least and greatest of the seeds; dotted: exact optimum)")
    axes.set_ylabel("return of the greedy policy")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="lower right")
    save(figure, path)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
