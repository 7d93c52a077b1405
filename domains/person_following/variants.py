"""Parameters of the task, and variants as named sets of their values."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from domains.core import DomainError
from domains.person_following.simulation.map_generation import MAX_SIZE
from domains.person_following.simulation.paths import HEADING_ALWAYS, HEADING_NEVER, HEADING_UNLESS_0

# Columns of the vector of rules that the kernel reads.
(
    R_NUM_CROSSINGS,
    R_SEE_THROUGH,
    R_MAX_STEPS,
    R_FOLLOW_DISTANCE,
    R_MAX_LOST,
    R_LOOK_BACK,
    R_PERSON_REST,
    R_ROBOT_REST,
    R_GOAL_PATIENCE,
    R_PERSON_START,
    R_KEEP_WAITING,
    R_FOLLOWING,
    R_MAP_SOURCE,
    R_NUM_GOALS,
    R_PERSON_SEES_ONLY,
    R_GOAL_MOVES_AT,
    R_TURNS_AT_GOAL,
    NUM_RULES,
) = range(18)

GENERATED, DRAWN, CYCLED = 0, 1, 2
"""Where the maps of new episodes come from (R_MAP_SOURCE)."""

START_CORNER, START_NEAR, START_FREE = 0, 1, 2
MAX_GOALS = 4
MAX_PERSONS = 8
_HEADINGS = {"never": HEADING_NEVER, "always": HEADING_ALWAYS, "unless-0": HEADING_UNLESS_0}
_STARTS = {"corner": START_CORNER, "near": START_NEAR, "free": START_FREE}
_KNOWLEDGE = ("map", "seen")
_ENDS = ("truncated", "terminated")


@dataclass(frozen=True)
class Parameters:
    """Every rule of the task that can be changed; the defaults are the `paper` variant.

    Steps that count from 1 within an episode are written t.
    """

    size: int = 9
    """Width and height of the map, border walls included; odd, 5 to 31."""
    num_crossings: int = 1
    """Number of rivers of wall."""
    view_size: int = 5
    """Width and height of the egocentric view; odd, 3 to 15."""
    see_through_walls: bool = True
    """Whether walls hide what is behind them (False) or not (True)."""
    max_steps: int = 200
    """t at which an episode is cut off."""
    follow_distance: int = 3
    """Greatest distance at which the robot still follows."""
    max_lost: int = 3
    """Steps in a row beyond the follow distance after which the person is lost."""
    look_back: bool = True
    """Whether the person waits, at most two steps in a row, for a robot unseen or too far."""
    person_rest: int = 0
    """The person stays where t is a multiple of this; 0 for never."""
    robot_rest: int = 0
    """The robot stays where t is a multiple of this, whatever it chooses; 0 for never."""
    goal_patience: int = 0
    """Steps the person stands at its goal before the episode ends unescorted where the robot is too far."""
    compare_heading: Literal["never", "always", "unless-0"] = "unless-0"
    """When a path to the person must end in its heading; `unless-0` is the quirk of the paper."""
    person_start: Literal["corner", "near", "free"] = "corner"
    """`corner`: at (2, 2), cutting a wall there (the quirk of the paper); `near`: on the free cell nearest to
    it; `free`: on the nearest one from which a greedy follower succeeds."""
    num_goals: int = 1
    """Cells that show as goals, 1 to 4; which one is the person's own is drawn, and only the person knows."""
    person_knows: Literal["map", "seen"] = "map"
    """`map`: the person plans on the true map; `seen`: on what it has seen, taking unseen cells as free."""
    goal_moves_at: int = 0
    """t at whose beginning the person's goal moves to the next candidate, unless the person sees the old
    place; 0 for never."""
    turns_at_goal: bool = True
    """Whether a person at its goal turns about at random, or stands still."""
    num_persons: int = 1
    """Persons in the map; the first is to be followed, the others walk about and stand in the way."""
    keep_waiting: bool = True
    """Whether the waiting counter lives on into the next episode (the quirk of the paper)."""
    lost_ends: Literal["truncated", "terminated"] = "truncated"
    """How an episode ends where the person is lost, or at its goal alone: as the paper's code has it (`truncated`), or
    in Gymnasium's words (`terminated`): there truncation is what a clock does, and learners bootstrap then."""

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            DomainError: a value outside its range.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            wanted = type(field.default)
            if wanted is int and isinstance(value, np.integer):
                object.__setattr__(self, field.name, int(value))
            elif type(value) is not wanted:
                raise DomainError(f"parameter '{field.name}' must be {wanted.__name__}, got {value!r}")
        if self.size % 2 == 0 or not 5 <= self.size <= MAX_SIZE:
            raise DomainError(f"size must be odd and in 5..{MAX_SIZE}, got {self.size}")
        feasible = self.size - 3
        if not 0 <= self.num_crossings <= feasible:
            raise DomainError(f"num_crossings must be in 0..{feasible} for size {self.size}, got {self.num_crossings}")
        if self.view_size % 2 == 0 or not 3 <= self.view_size <= 15:
            raise DomainError(f"view_size must be odd and in 3..15, got {self.view_size}")
        for name in ("max_steps", "max_lost"):
            if getattr(self, name) < 1:
                raise DomainError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name, most in (("num_goals", MAX_GOALS), ("num_persons", MAX_PERSONS)):
            if not 1 <= getattr(self, name) <= most:
                raise DomainError(f"{name} must be in 1..{most}, got {getattr(self, name)}")
        if self.goal_moves_at > 0 and self.num_goals < 2:
            raise DomainError("goal_moves_at needs num_goals of at least 2: the goal moves to another candidate")
        if self.num_goals > 1 and self.person_start == "corner":
            raise DomainError("num_goals above 1 needs person_start 'near' or 'free'")
        for name in ("follow_distance", "person_rest", "robot_rest", "goal_patience", "goal_moves_at"):
            if getattr(self, name) < 0:
                raise DomainError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in ("person_rest", "robot_rest"):
            if getattr(self, name) == 1:
                raise DomainError(f"{name} must be 0 (never) or at least 2, got 1: nobody would ever move")
        choices = {
            "compare_heading": _HEADINGS,
            "person_start": _STARTS,
            "person_knows": _KNOWLEDGE,
            "lost_ends": _ENDS,
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise DomainError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")

    @property
    def heading_rule(self) -> int:
        """The kernel's number for `compare_heading`."""
        return _HEADINGS[self.compare_heading]

    def rules(self, *, following: bool, map_source: int = GENERATED) -> NDArray[np.int64]:
        """The vector that the kernel reads, indexed by the R_ constants."""
        rules = np.zeros(NUM_RULES, np.int64)
        rules[R_NUM_CROSSINGS] = self.num_crossings
        rules[R_SEE_THROUGH] = self.see_through_walls
        rules[R_MAX_STEPS] = self.max_steps
        rules[R_FOLLOW_DISTANCE] = self.follow_distance
        rules[R_MAX_LOST] = self.max_lost
        rules[R_LOOK_BACK] = self.look_back
        rules[R_PERSON_REST] = self.person_rest
        rules[R_ROBOT_REST] = self.robot_rest
        rules[R_GOAL_PATIENCE] = self.goal_patience
        rules[R_PERSON_START] = _STARTS[self.person_start]
        rules[R_KEEP_WAITING] = self.keep_waiting
        rules[R_FOLLOWING] = following
        rules[R_NUM_GOALS] = self.num_goals if following else 1
        rules[R_PERSON_SEES_ONLY] = self.person_knows == "seen"
        rules[R_GOAL_MOVES_AT] = self.goal_moves_at
        rules[R_TURNS_AT_GOAL] = self.turns_at_goal
        rules[R_MAP_SOURCE] = map_source
        return rules


_CLEAN: dict[str, Any] = {"compare_heading": "always", "person_start": "free", "keep_waiting": False}
_OCCLUDED = _CLEAN | {"see_through_walls": False, "size": 13, "num_crossings": 3, "look_back": False}
# Tuned with the exact oracles so that mind-reading pays; how, and what did not work: docs/notes/variants.md.
_INTENT = _OCCLUDED | {
    "size": 9,
    "num_crossings": 1,
    "person_start": "near",
    "compare_heading": "never",
    "turns_at_goal": False,
    "num_goals": 4,
    "robot_rest": 4,
    "max_lost": 6,
    "goal_patience": 0,
    "max_steps": 60,
}
_FALSE_BELIEF = _INTENT | {"num_goals": 2, "goal_moves_at": 3, "max_lost": 3, "goal_patience": 4, "robot_rest": 5}
DISCOUNTS = {"occluded": 0.99, "intent": 0.99, "false_belief": 0.99}
"""Discounts per step of variants where what pays comes late; the others have the paper's, `domains.core.DISCOUNT`."""
VARIANTS: dict[str, dict[str, Any]] = {
    "paper": {},
    "clean": _CLEAN,
    "occluded": _OCCLUDED,
    "intent": _INTENT,
    "false_belief": _FALSE_BELIEF,
}


def parameters_of(variant: str = "paper", task: str = "following", **changes: Any) -> Parameters:
    """The parameters of a variant, with some of them changed by keyword.

    Raises:
        DomainError: an unknown variant or parameter, or a value outside its range.
    """
    if variant not in VARIANTS:
        raise DomainError(f"unknown variant '{variant}': known are {', '.join(VARIANTS)}")
    known = {field.name for field in dataclasses.fields(Parameters)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise DomainError(f"unknown parameter '{unknown[0]}': known are {', '.join(sorted(known))}")
    values = VARIANTS[variant] | changes
    if task == "crossing" and "max_steps" not in changes:
        size = values.get("size", Parameters.size)
        values["max_steps"] = 4 * size * size if isinstance(size, int) else 1
    return Parameters(**values)
