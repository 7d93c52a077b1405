"""What a domain offers to the rest: plain data, protocols and a lazy registry.

A domain is a family of partially observable tasks for a robot in a grid:

    S   full state, `env.state()`; never shown to an agent
    A   `DomainSpec.action_names`
    O   an egocentric view of cell kinds, `uint8 [v, v]`, and the configuration of another agent in it
    T   the environment's `step`
    R   the environment's reward

`nesy` and `planners` know this file and nothing else of a domain: they call `load_domain(name)`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from domains.recording import RecordedSteps as RecordedSteps
from domains.recording import StepRecorder as StepRecorder
from domains.symmetry import Symmetries as Symmetries
from domains.symmetry import Symmetry as Symmetry
from domains.symmetry import symmetries_of as symmetries_of

EMPTY, WALL, GOAL, UNSEEN = 0, 1, 2, 3
"""Cell kinds of a view; a grid has only the first three."""
CELL_KINDS = ("empty", "wall", "goal", "unseen")

LEFT, RIGHT, FORWARD, STAY = 0, 1, 2, 3
"""Actions of the robot; a person's actions are the same, with `wait` for `stay`."""
ACTION_NAMES = ("left", "right", "forward", "stay")

OUTCOMES = ("", "success", "agent_at_goal", "lost", "unescorted", "timeout")
"""How an episode ended, indexed by `infos["outcome_code"]`; the empty string while it goes on."""

Task: TypeAlias = Literal["crossing", "following"]

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
    tasks: tuple[str, ...] = ("crossing", "following")
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


@runtime_checkable
class BatchedEnvironment(Protocol):
    """A `gymnasium.vector.VectorEnv` (SAME_STEP autoreset) with what a learner of minds may ask besides.

    The observation is a dict: `view` uint8 `[B, v, v]` and `configuration` int64 `[B]`. `infos` of a step
    hold arrays `[B]` that describe the step just taken, before any reset: `outcome` (a name of `OUTCOMES`),
    `outcome_code`, `distance`, `visible`, `person_action`, `person_waited`; and `final_obs`,
    `final_person_view`, `final_relative_pose`, `final_counters`: what held after the step and before the
    reset, for EVERY environment (where no episode ended they equal the present values), with the mask
    `_final_obs` of the environments that were reset. After an autoreset all methods describe the new episode.
    """

    num_envs: int

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start new episodes everywhere."""
        ...

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take one action `[B]` per environment: observation, reward, terminated, truncated, infos."""
        ...

    def person_views(self) -> NDArray[np.uint8]:
        """`[B, v, v]`: the person's true view under the same visibility rule, neither agent shown."""
        ...

    def relative_poses(self) -> NDArray[np.int16]:
        """`[B, 3]` (side, ahead, heading): the person's true pose relative to the robot, also out of view."""
        ...

    def person_actions(self) -> NDArray[np.int8]:
        """`[B]`: the person's last action (0 left, 1 right, 2 forward, 3 wait); -1 after a reset."""
        ...

    def person_minds(self) -> NDArray[np.int16]:
        """`[B, 2, 2]`: (side, ahead) from the robot of where the person believes its goal to be, and where it is."""
        ...

    def counters(self) -> NDArray[np.int16]:
        """`[B, 2]`: the waiting counter and the lost counter."""
        ...

    def expert_actions(self, kind: str) -> NDArray[np.int64]:
        """`[B]`: first action of the A* path on the full map, to the `goal` or (`follower`) to the person."""
        ...

    def map_ids(self) -> NDArray[np.int64]:
        """`[B]`: a stable hash of each map as generated."""
        ...

    def states(self) -> list[dict[str, Any]]:
        """The full state of every environment, as `env.unwrapped.state()` of a single one returns it."""
        ...


class PredicateVocabulary(Protocol):
    """Observable predicates of a view: named, with a one-line meaning, computed vectorised."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the P predicates; each is also an ASP constant."""
        ...

    @property
    def meanings(self) -> Mapping[str, str]:
        """One line per name."""
        ...

    def evaluate(self, views: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Truth `[n, P]` of every predicate on views `[n, v, v]`."""
        ...


class OraclePolicy(Protocol):
    """An oracle's policy, asked through a batched environment.

    One of the full state looks at the present state alone. One under partial observability looks only at what the
    robot sees, and remembers it: ask it at every step of an episode, from the first on.
    """

    def actions(self, env: BatchedEnvironment) -> NDArray[np.int64]:
        """`[B]`: the policy's action in each environment's present situation."""
        ...


class ObservationPolicy(Protocol):
    """A policy of B robots that look at nothing but their observations, and remember."""

    def actions(
        self,
        observation: Mapping[str, NDArray[Any]],
        begun: NDArray[np.bool_] | None = None,
        acted: NDArray[np.int64] | None = None,
    ) -> NDArray[np.int64]:
        """`[B]`: actions for the present observations, asked at every step.

        Args:
            observation: as the environment returns it.
            begun: `[B]`, where an episode begins with this observation; None for nowhere but at the first call.
            acted: `[B]`, what was chosen at the step before; None where that is what this policy said.
        """
        ...


@dataclass(frozen=True)
class OracleResult:
    """An exact optimum over a finite set of worlds (maps, and persons' goals), `W` of them.

    `value` is discounted, `mean_return` is not; both are averages over worlds with `weights`. The arrays by map
    have one entry per world, `[W]`, the goals of a map side by side.
    """

    value: float
    mean_return: float
    success: float
    map_value: NDArray[np.float64]
    map_return: NDArray[np.float64]
    map_success: NDArray[np.float64]
    weights: NDArray[np.float64]
    discount: float
    policy: OraclePolicy = field(repr=False)

    def actions(self, env: BatchedEnvironment) -> NDArray[np.int64]:
        """The optimal actions `[B]` in the present states of `env`."""
        return self.policy.actions(env)


class Domain(Protocol):
    """A family of tasks."""

    @property
    def spec(self) -> DomainSpec:
        """What is fixed about the domain."""
        ...

    @property
    def predicates(self) -> PredicateVocabulary:
        """The observable predicates of a view."""
        ...

    def make(
        self,
        task: str,
        num_envs: int,
        variant: str = "paper",
        seed: int | None = None,
        maps: NDArray[np.uint8] | None = None,
        cycle: bool = False,
        **parameters: Any,
    ) -> BatchedEnvironment:
        """A batched environment; a `seed` fixes its first reset.

        `maps` `[M, size, size]`: start maps are drawn from this list instead of generated; with `cycle`,
        environment i's k-th episode is played on `maps[(i + k * num_envs) % M]`.
        """
        ...

    def maps(self, variant: str = "paper", **parameters: Any) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The distinct maps `[M, size, size]` and the generator's probabilities `[M]`.

        Raises:
            DomainError: the set is too large to be listed.
        """
        ...

    def views(self, variant: str = "paper", task: str = "following", **parameters: Any) -> NDArray[np.uint8]:
        """All distinct views [V, v, v] over maps and poses, sorted.

        Raises:
            DomainError: the set is too large to be listed.
        """
        ...

    def transitions(
        self, variant: str = "paper", task: str = "following", **parameters: Any
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.uint8]]:
        """Every step from every pose of every map, nobody else in the way: map, view, action, next view.

        Raises:
            DomainError: the set is too large to be listed.
        """
        ...

    def optimum(self, variant: str = "paper", discount: float | None = None, **parameters: Any) -> OracleResult:
        """The exact full-state optimum over the maps of `maps(variant, **parameters)`.

        `discount` of this and the other oracles: by default that of the variant, `spec.discount(variant)`.

        Raises:
            DomainError: there is no exact optimum, or too many maps for it.
        """
        ...

    def bayes_optimum(self, variant: str = "paper", discount: float | None = None, **parameters: Any) -> OracleResult:
        """The exact optimum of an agent that knows the set of worlds, and sees only its observations.

        Raises:
            DomainError: there is none, or the set of worlds is infinite or too large.
        """
        ...

    def egocentric_optimum(
        self, variant: str = "paper", discount: float | None = None, **parameters: Any
    ) -> OracleResult:
        """What the Bayes optimum becomes when the agent takes the person to know what is really so.

        The same information and the same planning, with a model of the person in which nobody is ever mistaken;
        played in the true task.

        Raises:
            DomainError: there is none, or the set of worlds is infinite or too large.
        """
        ...

    def last_seen_follower(self, num_envs: int, variant: str = "paper", **parameters: Any) -> ObservationPolicy:
        """A greedy follower of the person's last seen configuration, for B environments.

        Raises:
            DomainError: there is none.
        """
        ...

    def episode_metrics(
        self, steps: RecordedSteps, variant: str = "paper", **parameters: Any
    ) -> dict[str, NDArray[Any]]:
        """Every metric of every finished episode among recorded steps.

        Returns:
            Arrays `[E]`, one entry per finished episode, ordered by environment and then in time: `environment`,
            `episode` (0 for the first of its environment), every metric by name, and every name of `steps.extra`.
        """
        ...

    def belief_metrics(
        self,
        beliefs: NDArray[np.floating[Any]],
        true_codes: NDArray[np.integer[Any]],
        decoded_views: NDArray[np.uint8] | None = None,
        true_views: NDArray[np.uint8] | None = None,
    ) -> dict[str, NDArray[np.float64]]:
        """How well beliefs `[B, N, K]` about the person's view match its true code `[B, N]`: arrays `[B]`."""
        ...


_REGISTRY = {"person_following": "domains.person_following:DOMAIN"}


def register_domain(name: str, location: str) -> None:
    """Make `load_domain(name)` import `location`, written `package.module:attribute`."""
    if ":" not in location:
        raise DomainError(f"a domain's location is 'package.module:attribute', got '{location}'")
    _REGISTRY[name] = location


def load_domain(name: str = "person_following") -> Domain:
    """The domain registered under a name, imported on first use.

    Raises:
        DomainError: no domain of that name.
    """
    if name not in _REGISTRY:
        raise DomainError(f"unknown domain '{name}': known are {', '.join(sorted(_REGISTRY))}")
    module, _, attribute = _REGISTRY[name].partition(":")
    domain: Domain = getattr(importlib.import_module(module), attribute)
    return domain
