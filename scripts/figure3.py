"""Figure 3 of the paper: what is seen, believed, imagined and taken to be believed, moment by moment, as PNG.

One column per moment of an episode that the greedy follower plays: the map, the robot's view, its belief, the
imagined walk, the shifted belief, the view that it stands for, and what the person truly sees.

    python scripts/figure3.py --run runs/demo --output figure3.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

from domains.core import BatchedEnvironment, load_domain
from nesy.cli import configuration
from nesy.perspective import ImaginedPath, PerspectiveShift
from nesy.run_folder import RunFolder, atomic_path
from nesy.world_model import SymbolicCodec, load_world_model

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

COLOURS = ListedColormap(["#f4f1ea", "#4d4d4d", "#009E73", "#b9c6d6"])
ARROWS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
ACTIONS = "LRF."
ROWS = ("map", "robot's view", "belief b", "imagined walk", "shifted belief b~", "b~ decoded", "person's view")


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """A run with a trained world model."""
    output: Path = Path("figure3.png")
    """The PNG file."""
    moments: int = 5
    """Columns: moments with the person in view."""
    seed: int = 3
    """Seed of the episode."""


@dataclass(frozen=True)
class Moment:
    """All that a column shows."""

    state: dict[str, np.ndarray]
    view: np.ndarray
    belief: np.ndarray
    path: ImaginedPath
    decoded: np.ndarray
    person_view: np.ndarray


def moments(env: BatchedEnvironment, codec: SymbolicCodec, wanted: int) -> list[Moment]:
    """The first moments with the person in view and two or more imagined actions."""
    shift = PerspectiveShift(codec, "network" if codec.packed() is None else "table")
    found: list[Moment] = []
    observation, _ = env.reset()
    for _ in range(200):
        configuration = int(observation["configuration"][0])
        belief = codec.beliefs(observation["view"])[0]
        path = shift.imagine(belief, configuration)
        if path.reachable and len(path.actions) > 1:
            code = shift(belief[None], np.array([configuration])).codes
            state = env.states()[0]
            found.append(
                Moment(state, observation["view"][0], belief, path, codec.views(code)[0], env.person_views()[0])
            )
            if len(found) == wanted:
                break
        observation, *_ = env.step(env.expert_actions("follower"))
    return found


def _cells(axes: Axes, cells: np.ndarray) -> None:
    axes.imshow(cells.T, cmap=COLOURS, vmin=0, vmax=3)
    axes.set_xticks(np.arange(-0.5, len(cells)), [])
    axes.set_yticks(np.arange(-0.5, len(cells)), [])
    axes.grid(color="#ffffff", linewidth=0.5)
    axes.tick_params(length=0)


def _arrow(axes: Axes, x: int, y: int, heading: int, colour: str) -> None:
    dx, dy = ARROWS[heading] * 0.35
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2}
    axes.annotate("", (x + dx, y + dy), (x - dx, y - dy), arrowprops=style)


def _belief(axes: Axes, belief: np.ndarray) -> None:
    axes.imshow(belief, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])


def draw(columns: list[Moment], path: Path) -> None:
    """Write the figure."""
    figure, grid = plt.subplots(len(ROWS), len(columns), figsize=(1.9 * len(columns), 12), squeeze=False)
    for column, moment in enumerate(columns):
        axes = grid[:, column]
        _cells(axes[0], moment.state["grid"])
        _arrow(axes[0], *moment.state["agent"], "#D55E00")
        _arrow(axes[0], *moment.state["person"], "#0072B2")
        _cells(axes[1], moment.view)
        _arrow(axes[1], 2, 4, 3, "#D55E00")
        _arrow(axes[1], *moment.path.poses[-1], "#0072B2")
        _belief(axes[2], moment.belief)
        _cells(axes[3], moment.view)
        for pose in moment.path.poses:
            _arrow(axes[3], *pose, "#CC79A7")
        axes[3].set_xlabel("".join(ACTIONS[action] for action in moment.path.actions))
        _belief(axes[4], moment.path.beliefs[-1])
        _cells(axes[5], moment.decoded)
        right = int((moment.decoded == moment.person_view).sum())
        axes[5].set_xlabel(f"{right} of {moment.decoded.size} cells")
        _cells(axes[6], moment.person_view)
    for row, name in enumerate(ROWS):
        grid[row, 0].set_ylabel(name)
    figure.tight_layout()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": ""})
    plt.close(figure)


def main(arguments: Arguments) -> None:
    """Play, then draw."""
    run = RunFolder.open(arguments.run)
    run.require("train")
    config = configuration.load(run.config)
    env = load_domain(config.domain).make("following", 1, variant=config.variant, seed=arguments.seed)
    draw(moments(env, SymbolicCodec(load_world_model(run.world_model)), arguments.moments), arguments.output)
    print(arguments.output)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
