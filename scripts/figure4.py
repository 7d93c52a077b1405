"""Figure 4 of the paper: learning with input set `paper` under three influence modes, five seeds, 10,000 episodes.

    python scripts/figure4.py --run runs/demo --output runs/figure4 --jobs 2

Which order comes out depends on the world model: with the paper's own (a run made with --train.architecture paper
--train.epochs 20) that of the paper, with one that loses nothing another (docs/notes/comparison.md).

Leaves figure4.png, figure4.svg and figure4.json in the output folder, beside all that a comparison leaves. Called
again after a stop it goes on where it was. By default with the corrected learner (preset `fast`) and with the same
b~ in every mode, uniform, while the person is out of view; what the published code does otherwise is switched on
with --dqn.published-..., each on its own, or all at once with --preset published.
"""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.parquet as pq
import tyro

from nesy.errors import UserError
from nesy.progress import ConsoleProgress
from nesy.report.comparison_figures import exact_optima, learning, save
from nesy.run_folder import RunFolder, read_json, write_json
from planners.comparison.compare import compare
from planners.comparison.statistics import over_seeds
from planners.config import LEARNERS, CompareConfig, DQNConfig, LearnerName

MODES = ("random", "perspective-shift", "perfect-information")
PUBLISHED = (
    "Published code, last 1,000 of 10,000 episodes: perspective-shift 24.2 and 10.7 (two seeds), "
    "perfect-information 10.1, random 2.2 (one seed each)."
)


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """A run with a trained world model."""
    output: Path = Path("runs/figure4")
    """Where the trainings, the tables and the figure go."""
    preset: LearnerName = "fast"
    """Settings of the learner to start from."""
    episodes: int = 10_000
    """Training episodes."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds; every mode is learned once per seed."""
    modes: tuple[str, ...] = MODES
    """Influence modes."""
    final: int = 1000
    """Training episodes at the end that the table is about."""
    jobs: int = 2
    """Processes."""
    engine: Literal["local", "ray"] = "local"
    """Where the trainings run."""
    address: str | None = None
    """Address of the Ray cluster."""
    dqn: DQNConfig = field(default_factory=DQNConfig.fast)
    """How the DQN learns."""


def defaults(arguments: list[str]) -> Arguments:
    """The options where the command line says nothing: those of the preset that it names."""
    named = next((name for name in LEARNERS if f"--preset={name}" in arguments or _follows(arguments, name)), "fast")
    return Arguments(dqn=LEARNERS[named](10_000))


def _follows(arguments: list[str], name: str) -> bool:
    return any(pair == ("--preset", name) for pair in pairwise(arguments))


def make(options: Arguments) -> dict[str, Any]:
    """Learn what is missing, and draw."""
    output = RunFolder(options.output)
    if not (options.run / "world_model").is_dir():
        raise UserError(f"{options.run}: holds no world model; train one with: nesy run --run {options.run}")
    if not output.world_model.is_dir():
        shutil.copytree(options.run / "world_model", output.world_model)
    dqn = replace(options.dqn, episodes=options.episodes)
    config = CompareConfig(
        agents=("dqn", "optimum"), inputs=("paper",), influences=options.modes, seeds=options.seeds, dqn=dqn
    )
    started = time.perf_counter()
    records = compare(
        output, config, 0, options.jobs, ConsoleProgress(), engine=options.engine, address=options.address
    )
    seconds = time.perf_counter() - started
    result: dict[str, Any] = {
        "seconds": round(seconds, 1),
        "jobs": options.jobs,
        "episodes": options.episodes,
        "seeds": len(options.seeds),
        "final_episodes": options.final,
        "world_model": world_model(output),
        "modes": final_returns(output, options),
        "evaluation": {record["influence"] or "optimum": record["return"] for record in records},
    }
    result["ranking"] = ranking(result["modes"])
    write_json(options.output / "figure4.json", result)
    curves = read_json(output.results / "statistics.json")["curves"]
    for curve in curves:
        curve["name"] = next(mode for mode in options.modes if f"/ {mode} /" in curve["name"])
    bands = f"Bands: 95 % over {len(options.seeds)} seeds. World model: {result['world_model']}."
    notes = (f"{bands} {result['ranking']}", PUBLISHED)
    save(learning(curves, exact_optima(records), notes), options.output / "figure4")
    return result


def world_model(output: RunFolder) -> str:
    """Which world model the beliefs come from, and how well it rebuilds views."""
    stored = read_json(output.world_model / "config.json")
    exact = stored.get("metrics", {}).get("views_exact")
    quality = "" if exact is None else f", {100 * exact:.0f} % of the views exact"
    return f"{stored['model']['architecture']}{quality}"


def final_returns(output: RunFolder, options: Arguments) -> dict[str, Any]:
    """Return, success and running average over the last training episodes, with intervals over seeds."""
    rows = pq.read_table(output.results / "episodes.parquet", filters=[("phase", "=", "train")])
    columns = {name: rows[name].to_numpy() for name in ("influence", "seed", "episode", "return", "outcome")}
    found = {}
    for mode in options.modes:
        everything = columns["influence"] == mode
        last = everything & (columns["episode"] >= options.episodes - options.final)
        seeds, success = columns["seed"][last], columns["outcome"][last] == "success"
        found[mode] = {
            "return": over_seeds(columns["return"][last], seeds, 0).as_dict(),
            "success": over_seeds(success.astype(float), seeds, 0).as_dict(),
            "running_average": over_seeds(columns["return"][everything], columns["seed"][everything], 0).as_dict(),
            "per_seed": {str(s): float(columns["return"][last][seeds == s].mean()) for s in np.unique(seeds)},
        }
    return found


def ranking(modes: dict[str, Any]) -> str:
    """The modes from best to worst, `>` where the intervals do not overlap and `~` where they do or there are none."""
    ordered = sorted(modes, key=lambda mode: -modes[mode]["return"]["mean"])
    text = ordered[0]
    for better, worse in pairwise(ordered):
        low, high = modes[better]["return"]["low"], modes[worse]["return"]["high"]
        apart = None not in (low, high) and low > high
        text += f" {'>' if apart else '~'} {worse}"
    return f"Final training episodes: {text}."


if __name__ == "__main__":
    import sys

    try:
        chosen = tyro.cli(Arguments, description=__doc__, default=defaults(sys.argv[1:]))
        print(json.dumps(make(chosen), indent=2))
    except UserError as mistake:
        raise SystemExit(f"figure4: {mistake}") from None
