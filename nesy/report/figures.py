"""Figures of the report, each a function from plain data to SVG text.

Colours are Okabe and Ito's, which stay apart for colour-blind readers.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

# Ids in an SVG are hashes with a salt that is otherwise random: the same data are to give the same file.
matplotlib.rcParams["svg.hashsalt"] = "nesy"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# empty, wall, goal, unseen
CELL_COLOURS = ListedColormap(["#f4f1ea", "#4d4d4d", "#009E73", "#b9c6d6"])


@dataclass(frozen=True)
class BeliefExample:
    """One moment: what the robot sees, what it believes, and what it takes the person to believe.

    Attributes:
        view: uint8 [5, 5], the robot's view, indexed [vx, vy].
        person: (vx, vy, heading) of the person in that view.
        belief: float [N, K], the robot's belief b.
        shifted: float [N, K], the shifted belief b~.
        decoded: uint8 [5, 5], what b decodes to.
        decoded_shifted: uint8 [5, 5], what b~ decodes to.
        person_view: uint8 [5, 5], what the person really sees.
        actions: names of the imagined actions.
    """

    view: np.ndarray
    person: tuple[int, int, int]
    belief: np.ndarray
    shifted: np.ndarray
    decoded: np.ndarray
    decoded_shifted: np.ndarray
    person_view: np.ndarray
    actions: tuple[str, ...]


def svg(figure: Figure) -> str:
    """The figure as an inline <svg> element, with no date in it so that the same data give the same text."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)  # a no-op for figures made without pyplot
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def belief_panel(example: BeliefExample) -> str:
    """The robot's view and belief beside the shifted belief and the person's true view."""
    figure, axes = plt.subplots(2, 3, figsize=(10, 6.2))
    _view(axes[0, 0], example.view, "robot's view (triangle: the person)")
    _triangle(axes[0, 0], example.person)
    _belief(axes[0, 1], example.belief, "robot's belief b")
    _view(axes[0, 2], example.decoded, "b decoded")
    _view(axes[1, 0], example.person_view, "person's true view")
    _belief(axes[1, 1], example.shifted, "perspective-shifted belief b~")
    _view(axes[1, 2], example.decoded_shifted, "b~ decoded")
    figure.suptitle("imagined actions: " + (", ".join(example.actions) or "none"), fontsize=10)
    figure.tight_layout()
    return svg(figure)


def _view(axes: Axes, view: np.ndarray, title: str) -> None:
    axes.imshow(view.T, cmap=CELL_COLOURS, vmin=0, vmax=3)
    size = view.shape[0]
    axes.set_xticks(np.arange(-0.5, size), [])
    axes.set_yticks(np.arange(-0.5, size), [])
    axes.tick_params(length=0)
    axes.grid(color="#999999", linewidth=0.5)
    _triangle(axes, (size // 2, size - 1, 3), colour="#D55E00")
    axes.set_title(title, fontsize=10)


def _triangle(axes: Axes, pose: tuple[int, int, int], colour: str = "#0072B2") -> None:
    """A triangle at (vx, vy) that points along the heading (0 right, 1 down, 2 left, 3 up)."""
    markers = (">", "v", "<", "^")
    axes.plot(pose[0], pose[1], markers[pose[2] % 4], color=colour, markersize=11)


def _belief(axes: Axes, belief: np.ndarray, title: str) -> None:
    image = axes.imshow(belief, cmap="viridis", vmin=0, vmax=1, aspect="auto")
    axes.set_xlabel("value")
    axes.set_ylabel("factor")
    axes.set_xticks(range(belief.shape[1]))
    axes.set_yticks(range(belief.shape[0]))
    axes.set_title(title, fontsize=10)
    axes.figure.colorbar(image, ax=axes, fraction=0.046)
