"""Curves of the planner: return against budget, and against the prior; how well the particles hold.

    python scripts/planner_curves.py --run runs/demo --output runs/curves [--budgets 10 100 1000 10000] [--seeds 0 1 2]

For every budget (simulations per decision), prior over the person's code (influence mode) and seed, plays the maps of
a run's variant with the agent `search` and its learned tables. Leaves `curves.json` and `curves.svg`: mean return with
a 95 % interval; effective particles as a share, and decisions in a belief of fewer than a twentieth of them. Every map
is played at every point, so the interval is of what a point loses against the best return seen on each map: what maps
differ in is no chance.
What is there already is not measured again, so a stopped run goes on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from domains.core import Domain, load_domain
from nesy.perspective.influence import INFLUENCE_MODES
from nesy.run_folder import RunFolder, atomic_path
from planners.agents import Situation
from planners.comparison.evaluation import Player, evaluate
from planners.config import SearchConfig
from planners.perception import Perception
from planners.person_following.agent import PlanningAgent
from planners.person_following.ialm import IALM


class WatchedAgent(PlanningAgent):
    """The planning agent, and what its beliefs and searches were like at every decision.

    Attributes:
        seen: per decision: (effective particles, deepest step, decisions before it that had to start afresh).
    """

    def actions(self, situation: Situation) -> np.ndarray:
        """Plan in each episode, and take notes."""
        chosen = super().actions(situation)
        if situation.last_actions is None:
            self.seen: list[tuple[float, float, float]] = []
        for i in np.flatnonzero(situation.active):
            info: dict[str, Any] = self.infos[i]
            self.seen.append((info["effective"], info.get("max_depth", 1), info["resets"]))
        return chosen


def main() -> None:
    """Measure what is missing, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--variant", default="paper")
    parser.add_argument("--budgets", type=int, nargs="+", default=[10, 30, 100, 300, 1000, 3000, 10_000])
    parser.add_argument("--priors", nargs="+", choices=INFLUENCE_MODES, default=list(INFLUENCE_MODES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=42)
    arguments = parser.parse_args()
    path = arguments.output / "curves.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    known = {(row["variant"], row["budget"], row["prior"], row["seed"], len(row["returns"])) for row in rows}
    domain, run = load_domain(), RunFolder(arguments.run)
    for budget in arguments.budgets:
        for prior in arguments.priors:
            for seed in arguments.seeds:
                if (arguments.variant, budget, prior, seed, arguments.episodes) in known:
                    continue
                rows.append(measure(domain, run, arguments.variant, budget, prior, seed, arguments.episodes))
                with atomic_path(path) as temporary:
                    temporary.write_text(json.dumps(rows, indent=1), encoding="utf-8")
                print(f"{budget} simulations, {prior}, seed {seed}: {np.mean(rows[-1]['returns']):.2f}", flush=True)
    with atomic_path(arguments.output / "curves.svg") as temporary:
        temporary.write_text(drawn([row for row in rows if row["variant"] == arguments.variant]), encoding="utf-8")


def measure(
    domain: Domain, run: RunFolder, variant: str, budget: int, prior: str, seed: int, episodes: int
) -> dict[str, Any]:
    """Play the episodes of one point of the curves."""
    from nesy.world_model import SymbolicCodec, load_world_model

    codec, model = SymbolicCodec(load_world_model(run.world_model)), IALM.load(run.ialm)
    config = replace(SearchConfig(), simulations=budget).at(domain.spec.discount(variant))
    agent = WatchedAgent("search", model, config, domain.spec.geometry, seed, prior)
    perception = Perception(codec, prior, np.random.default_rng([seed, 1]))
    columns = evaluate(domain, variant, Player(agent, perception), episodes, seed)
    seen = np.array(agent.seen)
    return {
        "variant": variant,
        "budget": budget,
        "prior": prior,
        "seed": seed,
        "returns": columns["return"].tolist(),
        "map_ids": [int(name) for name in columns["map_id"]],
        "ms_per_decision": float(np.median(columns["ms_per_decision"])),
        "effective_share": float(seen[:, 0].mean() / config.particles),
        "depleted_share": float((seen[:, 0] < 0.05 * config.particles).mean()),
        "resets_per_episode": float(sum(belief.resets for belief in agent.beliefs) / episodes),
        "mean_of_deepest": float(seen[:, 1].mean()),
    }


def drawn(rows: list[dict[str, Any]]) -> str:
    """Both curves and the particles as one SVG."""
    from matplotlib.figure import Figure

    from nesy.report.figures import PALETTE, svg

    figure = Figure(figsize=(9, 2.8), layout="constrained")
    panels = figure.subplots(1, 3)
    best: dict[int, float] = {}
    for row in rows:
        for name, reached in zip(row["map_ids"], row["returns"], strict=True):
            best[name] = max(best.get(name, -np.inf), reached)
    priors = [prior for prior in INFLUENCE_MODES[::-1] if any(row["prior"] == prior for row in rows)]
    for number, prior in enumerate(priors):
        mine = [row for row in rows if row["prior"] == prior]
        budgets = np.array(sorted({row["budget"] for row in mine}))
        at = [[row for row in mine if row["budget"] == budget] for budget in budgets]
        lost = [np.concatenate([[best[m] for m in r["map_ids"]] - np.array(r["returns"]) for r in rs]) for rs in at]
        beside = budgets * 1.06 ** (number - (len(priors) - 1) / 2)  # intervals side by side
        style: dict[str, Any] = {
            "label": prior,
            "color": PALETTE[number % len(PALETTE)],
            "marker": "o",
            "markersize": 4,
        }
        error = [1.96 * values.std() / np.sqrt(len(values)) for values in lost]
        means = [np.mean([np.mean(row["returns"]) for row in rs]) for rs in at]
        panels[0].errorbar(beside, means, error, capsize=2, **style)
        for axes, name in ((panels[1], "effective_share"), (panels[2], "depleted_share")):
            axes.plot(budgets, [np.mean([row[name] for row in rs]) for rs in at], **style)
    titles = ("return", "effective particles,\nshare of all", "decisions with less than\n5 % effective particles")
    for axes, title in zip(panels, titles, strict=True):
        axes.set(xscale="log", xlabel="simulations per decision")
        axes.set_title(title, fontsize=9)
        axes.grid(color="#999999", linewidth=0.3)
    for axes in panels[1:]:
        axes.set_ylim(0, 1)
    panels[2].legend(fontsize=7, loc="center right")
    return svg(figure)


if __name__ == "__main__":
    main()
