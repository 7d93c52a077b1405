"""Pictures of what the planner believes of the person, step by step through one episode.

    python scripts/belief_pictures.py --run runs/demo --output runs/beliefs.svg [--map 29] [--prior perspective-shift]

Above: where the person may be, seen from the robot (which stands at the arrow and looks up), with a ring where it is.
Below: the person's code, one column per factor, darker where a value is believed more, with a dot at the true value.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from domains.core import load_domain
from nesy.perspective.influence import INFLUENCE_MODES
from nesy.run_folder import RunFolder, atomic_path
from planners.agents import Situation
from planners.config import SearchConfig
from planners.perception import Perception
from planners.person_following.agent import PlanningAgent
from planners.person_following.ialm import IALM


class Moment(NamedTuple):
    """One step: P(c) [2W + 1, 2W + 1], the true (side, ahead), P(y) [N, K], the true code [N], whether it was seen."""

    place: np.ndarray
    true_place: tuple[int, int]
    code: np.ndarray
    true_code: np.ndarray
    visible: bool


def main() -> None:
    """Play and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--variant", default="paper")
    parser.add_argument("--map", type=int, default=0, help="number of the map among those that the variant draws")
    parser.add_argument("--prior", choices=INFLUENCE_MODES, default="perspective-shift")
    parser.add_argument("--steps", type=int, default=8, help="steps drawn, evenly spread over the episode")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    moments = played(arguments.run, arguments.variant, arguments.map, arguments.prior, arguments.seed)
    chosen = np.unique(np.linspace(0, len(moments) - 1, arguments.steps).round().astype(int))
    with atomic_path(arguments.output) as temporary:
        temporary.write_text(drawn([moments[t] for t in chosen], chosen.tolist()), encoding="utf-8")


def played(folder: Path, variant: str, number: int, prior: str, seed: int) -> list[Moment]:
    """One episode of the agent `search`, with its belief before every action."""
    from nesy.world_model import SymbolicCodec, load_world_model

    run, domain = RunFolder(folder), load_domain()
    codec, model = SymbolicCodec(load_world_model(run.world_model)), IALM.load(run.ialm)
    env: Any = domain.make("following", 1, variant=variant, seed=seed, maps=domain.maps(variant)[0][[number]])
    observation, _ = env.reset(seed=seed)
    config = replace(SearchConfig(), particles=1000).at(domain.spec.discount(variant))
    agent = PlanningAgent("search", model, config, domain.spec.geometry, seed, prior)
    perception = Perception(codec, prior, np.random.default_rng([seed, 1]))
    moments: list[Moment] = []
    active, last = np.ones(1, np.bool_), None
    while active[0]:
        percepts = perception(observation, env.person_views())
        actions = agent.actions(Situation(env, observation, percepts, active, last))
        belief, window = agent.beliefs[0], model.motion.window
        side, ahead = (int(part) + window for part in env.relative_poses()[0, :2])
        moments.append(
            Moment(
                belief.pose_marginal().sum(axis=2),
                (min(max(side, 0), 2 * window), min(max(ahead, 0), 2 * window)),
                belief.person_marginals(),
                codec.codes(env.person_views())[0],
                bool(percepts.configurations[0] > 0),
            )
        )
        observation, _, terminated, truncated, _ = env.step(actions)
        active, last = active & ~(np.asarray(terminated) | np.asarray(truncated)), actions
    env.close()
    return moments


def drawn(moments: list[Moment], steps: list[int]) -> str:
    """The moments side by side, as SVG text."""
    from matplotlib.figure import Figure

    from nesy.report.figures import svg

    figure = Figure(figsize=(1.3 * len(moments) + 0.4, 3.2), layout="constrained")
    rows = figure.subplots(2, len(moments), squeeze=False)
    for above, below, moment, step in zip(rows[0], rows[1], moments, steps, strict=True):
        middle = moment.place.shape[0] // 2
        above.imshow(moment.place.T, origin="lower", cmap="Blues", vmin=0, vmax=1)
        above.plot(middle, middle, marker="^", color="black", markersize=5)
        above.plot(*moment.true_place, marker="o", markerfacecolor="none", markeredgecolor="tab:red", markersize=8)
        above.set_title(f"step {step}, {'seen' if moment.visible else 'unseen'}", fontsize=7)
        below.imshow(moment.code.T, origin="lower", cmap="Greys", vmin=0, vmax=1, aspect="auto")
        below.plot(np.arange(len(moment.true_code)), moment.true_code, "o", color="tab:red", markersize=3)
        for axes in (above, below):
            axes.set(xticks=[], yticks=[])
        above.set_xlabel(f"{moment.place.shape[0]} x {moment.place.shape[1]} cells", fontsize=6)
        below.set_xlabel("factor", fontsize=6)
    rows[0, 0].set_ylabel("where the person is,\nas the robot looks", fontsize=7)
    rows[1, 0].set_ylabel("the person's code:\nvalue of each factor", fontsize=7)
    return svg(figure)


if __name__ == "__main__":
    main()
