"""Figure 3 of the paper: what is seen, believed, imagined and taken to be believed, in moments of several episodes.

One column per moment: the map, the robot's view, its belief and what that decodes to, the imagined walk, the shifted
belief and what that decodes to, the person's true view and the belief that the encoder would have of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np

from domains.core import load_domain
from nesy.errors import UserError
from nesy.perspective.operator import ImaginedPath, PerspectiveShift
from nesy.report.figures import CELL_COLOURS
from nesy.run_folder import RunFolder, read_json
from nesy.world_model import SymbolicCodec, load_world_model

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

ARROWS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
ACTIONS = ("left", "right", "forward", "stay")
ROBOT, PERSON, WALK = "#D55E00", "#0072B2", "#CC79A7"
ROWS = (
    "map", "robot's view", "belief b", "b decoded", "imagined walk", "shifted belief b~", "b~ decoded",
    "person's view", "belief of that",
)  # fmt: skip
STEPS = 60
"""Steps of an episode in which a moment is looked for."""
LATER = 3
"""By how many steps the search begins later in each next episode, so that moments differ."""


@dataclass(frozen=True)
class Moment:
    """All that a column shows.

    Attributes:
        state: of the environment (`grid`, `agent`, `person`).
        view: uint8 [v, v], the robot's.
        belief: float32 [N, K], of that view.
        decoded: uint8 [v, v], what it decodes to.
        path: the imagined walk, which ends with the shifted belief.
        shifted: uint8 [v, v], what that decodes to.
        person_view: uint8 [v, v], the true one.
        person_belief: float32 [N, K], the encoder's of that.
    """

    state: dict[str, np.ndarray]
    view: np.ndarray
    belief: np.ndarray
    decoded: np.ndarray
    path: ImaginedPath
    shifted: np.ndarray
    person_view: np.ndarray
    person_belief: np.ndarray


def moments(run: RunFolder, count: int, seed: int = 3, least: int = 3) -> list[Moment]:
    """Moments of episodes that the follower plays, one of each episode.

    Chosen by what is seen, never by how well the shifted belief turns out: the first moment from a given step of an
    episode on, later in every next one, in which the imagined walk has `least` actions or more.

    Args:
        run: with a trained world model.
        count: most moments.
        seed: of the episodes.
        least: fewest imagined actions.

    Raises:
        UserError: no such moment is found.
    """
    config = read_json(run.config)
    domain = load_domain(str(config.get("domain", "person_following")))
    env = domain.make(domain.spec.main_task, 4 * count, variant=str(config.get("variant", "paper")), seed=seed)
    codec = SymbolicCodec(load_world_model(run.world_model))
    shift = PerspectiveShift(codec, "network" if codec.packed() is None else "table")
    found: dict[int, Moment] = {}
    observation, _ = env.reset()
    playing = np.ones(env.num_envs, dtype=bool)
    begin = np.arange(env.num_envs) % count * LATER
    for step in range(STEPS):
        beliefs = codec.beliefs(observation["view"])
        configurations = np.asarray(observation["configuration"], dtype=np.int64)
        shifted = shift(beliefs, configurations)
        states, person_views = env.states(), env.person_views()
        for i in np.flatnonzero(playing & (begin <= step) & shifted.reachable & (shifted.num_actions >= least)):
            if int(i) not in found:
                view, own = observation["view"][i].copy(), person_views[i].copy()
                found[int(i)] = Moment(
                    state=states[i],
                    view=view,
                    belief=beliefs[i],
                    decoded=codec.views(codec.codes(view[None]))[0],
                    path=shift.imagine(beliefs[i], int(configurations[i])),
                    shifted=codec.views(shifted.codes[i][None])[0],
                    person_view=own,
                    person_belief=codec.beliefs(own[None])[0],
                )
        if len({i % count for i in found}) == count:
            break
        observation, _, terminated, truncated, _ = env.step(env.expert_actions("follower"))
        playing &= ~(terminated | truncated)
    if not found:
        raise UserError(f"{run.path}: no moment with the person in view and {least} imagined actions in any episode")
    first = {i % count: moment for i, moment in sorted(found.items(), reverse=True)}
    return [first[i] for i in sorted(first)]


def draw(columns: list[Moment]) -> Figure:
    """The figure."""
    figure, grid = plt.subplots(len(ROWS), len(columns), figsize=(1.75 * len(columns) + 0.4, 15.5), squeeze=False)
    for column, moment in enumerate(columns):
        axes = grid[:, column]
        size = len(moment.view)
        _cells(axes[0], moment.state["grid"])
        for agent, colour in (("agent", ROBOT), ("person", PERSON)):
            x, y, heading = (int(part) for part in moment.state[agent])
            _arrow(axes[0], x, y, heading, colour)
        _cells(axes[1], moment.view)
        _arrow(axes[1], size // 2, size - 1, 3, ROBOT)
        _arrow(axes[1], *moment.path.poses[-1], PERSON)
        _belief(axes[2], moment.belief)
        _reconstruction(axes[3], moment.decoded, moment.view)
        _cells(axes[4], moment.view)
        for pose in moment.path.poses:
            _arrow(axes[4], *pose, WALK)
        letters = "".join(ACTIONS[action][0].upper() for action in moment.path.actions)
        axes[4].set_xlabel(letters, fontsize=8)
        _belief(axes[5], moment.path.beliefs[-1])
        _reconstruction(axes[6], moment.shifted, moment.person_view)
        _cells(axes[7], moment.person_view)
        _arrow(axes[7], size // 2, size - 1, 3, PERSON)
        _belief(axes[8], moment.person_belief)
    for row, name in enumerate(ROWS):
        grid[row, 0].set_ylabel(name, fontsize=9)
    figure.tight_layout()
    return figure


def _cells(axes: Axes, cells: np.ndarray) -> None:
    axes.imshow(cells.T, cmap=CELL_COLOURS, vmin=0, vmax=3)
    axes.set_xticks(np.arange(-0.5, len(cells)), [])
    axes.set_yticks(np.arange(-0.5, len(cells)), [])
    axes.grid(color="#ffffff", linewidth=0.5)
    axes.tick_params(length=0)


def _reconstruction(axes: Axes, decoded: np.ndarray, true: np.ndarray) -> None:
    _cells(axes, decoded)
    for x, y in np.argwhere(decoded != true):
        axes.plot(x, y, "x", color=ROBOT, markersize=7)
    axes.set_xlabel(f"{int((decoded == true).sum())} of {true.size} cells", fontsize=8)


def _arrow(axes: Axes, x: int, y: int, heading: int, colour: str) -> None:
    dx, dy = ARROWS[heading] * 0.35
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2}
    axes.annotate("", (x + dx, y + dy), (x - dx, y - dy), arrowprops=style)


def _belief(axes: Axes, belief: np.ndarray) -> None:
    axes.imshow(belief, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])
