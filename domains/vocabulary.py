"""The words that all worlds share, as plain data: cell kinds, actions, outcomes, the geometry of views, the spec."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

EMPTY, WALL, GOAL, UNSEEN = 0, 1, 2, 3
"""Cell kinds of a view; a grid has only the first three."""
CELL_KINDS = ("empty", "wall", "goal", "unseen")

LEFT, RIGHT, FORWARD, STAY = 0, 1, 2, 3
"""Actions of the robot; a person's actions are the same, with `wait` for `stay`."""
ACTION_NAMES = ("left", "right", "forward", "stay")

OUTCOMES = ("", "success", "agent_at_goal", "lost", "unescorted", "timeout")
"""How an episode ended, indexed by `infos["outcome_code"]`; the empty string while it goes on."""

TASKS = ("crossing", "following")
"""Kinds of tasks: in `crossing` nobody else is there, in `following` there is a person. A world has one or both."""

Weighting: TypeAlias = Literal["visits", "maps"]

DISCOUNT = 0.9
"""Discount per step where a variant names none of its own."""
MOST_MAPS = 5_000
"""Of more maps than these nothing is worked out map by map: `occluded` has 51,520, with 76 million steps."""


class DomainError(ValueError):
    """A mistake of the caller's: the message says what was wrong, where, and what would be right."""


@dataclass(frozen=True)
class ViewGeometry:
    """Coordinates of an egocentric square view and of another agent's configuration in it.

    View coordinates (vx, vy): the viewer stands at `viewer` and looks "up", towards vy = 0, so its own
    heading is 3 in view coordinates. A configuration is 0 when the other agent is unseen, else
    `1 + ((vx * view_size) + vy) * 4 + relative heading`.
    """

    view_size: int = 5

    @property
    def viewer(self) -> tuple[int, int]:
        """View coordinates of the viewer's own cell."""
        return self.view_size // 2, self.view_size - 1

    @property
    def num_configurations(self) -> int:
        """Number of values a configuration can take, `unseen` included."""
        return 1 + self.view_size**2 * 4

    def encode(self, vx: ArrayLike, vy: ArrayLike, heading: ArrayLike) -> NDArray[np.int64]:
        """Configuration of another agent at (vx, vy) with a relative heading; elementwise.

        Raises:
            DomainError: a coordinate outside the view or a heading outside 0..3.
        """
        x, y, h = (np.asarray(part, dtype=np.int64) for part in (vx, vy, heading))
        if ((x < 0) | (x >= self.view_size) | (y < 0) | (y >= self.view_size)).any():
            raise DomainError(f"view coordinates must be in 0..{self.view_size - 1}, got ({vx!r}, {vy!r})")
        if ((h < 0) | (h > 3)).any():
            raise DomainError(f"a relative heading must be in 0..3, got {heading!r}")
        return np.asarray(1 + (x * self.view_size + y) * 4 + h)

    def decode(self, configuration: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """(vx, vy, relative heading) of configurations; all three are -1 where the agent is unseen.

        Raises:
            DomainError: a configuration outside `range(num_configurations)`.
        """
        value = np.asarray(configuration, dtype=np.int64)
        if ((value < 0) | (value >= self.num_configurations)).any():
            largest = self.num_configurations - 1
            raise DomainError(f"a configuration must be in 0..{largest}, got {configuration!r}")
        pose = value - 1
        unseen = value == 0
        vx = np.where(unseen, -1, pose // 4 // self.view_size)
        vy = np.where(unseen, -1, pose // 4 % self.view_size)
        return vx, vy, np.where(unseen, -1, pose % 4)

    def relative(self, configuration: ArrayLike) -> NDArray[np.int64]:
        """(side to the right, steps ahead, heading) `[..., 3]` of configurations; -1s where unseen."""
        vx, vy, heading = self.decode(configuration)
        unseen = heading < 0
        side = np.where(unseen, -1, vx - self.view_size // 2)
        ahead = np.where(unseen, -1, self.view_size - 1 - vy)
        return np.stack([side, ahead, heading], axis=-1)


@dataclass(frozen=True)
class DomainSpec:
    """What is fixed about a domain."""

    name: str
    variants: tuple[str, ...]
    action_names: tuple[str, ...] = ACTION_NAMES
    geometry: ViewGeometry = ViewGeometry()
    cell_kinds: tuple[str, ...] = CELL_KINDS
    tasks: tuple[str, ...] = TASKS
    """Which of `TASKS` the world has."""
    outcomes: tuple[str, ...] = OUTCOMES
    weighting: Weighting = "visits"
    """What a transition counts as in learning: how often it was met, or, where a task needs a model that does not
    depend on where the behaviour that collected experience liked to go, on how many maps (chances are lost)."""
    discounts: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Discount per step of each variant that does not have the usual one; ask `discount`."""

    def discount(self, variant: str) -> float:
        """Discount per step of a variant: the one place that oracles, learners, planners and evaluation ask."""
        return self.discounts.get(variant, DISCOUNT)

    @property
    def num_cell_kinds(self) -> int:
        """Number of kinds a cell of a view can have."""
        return len(self.cell_kinds)

    @property
    def has_person(self) -> bool:
        """Whether a task of the world has a person in it."""
        return "following" in self.tasks

    @property
    def main_task(self) -> str:
        """The task in which agents learn and are compared: with the person, where the world has one."""
        return "following" if self.has_person else self.tasks[0]

    @property
    def model_task(self) -> str:
        """The task in which a model of the world is measured: with nobody in the way, where the world has it."""
        return "crossing" if "crossing" in self.tasks else self.tasks[0]
