"""What a domain offers to the rest: plain data, protocols, and how a domain is loaded by its name.

A domain is a family of partially observable tasks for a robot in a grid:

    S   full state, `env.state()`; never shown to an agent
    A   `DomainSpec.action_names`
    O   an egocentric view of cell kinds, `uint8 [v, v]`, and the configuration of another agent in it
    T   the environment's `step`
    R   the environment's reward

`nesy` and `planners` know this file and nothing else of a domain: they call `load_domain(name)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from domains import defaults, worlds
from domains.recording import RecordedSteps, StepRecorder
from domains.symmetry import Symmetries, Symmetry, symmetries_of
from domains.vocabulary import (
    ACTION_NAMES,
    CELL_KINDS,
    DISCOUNT,
    EMPTY,
    FORWARD,
    GOAL,
    LEFT,
    MOST_MAPS,
    OUTCOMES,
    RIGHT,
    STAY,
    TASKS,
    UNSEEN,
    WALL,
    DomainError,
    DomainSpec,
    ViewGeometry,
    Weighting,
)
from domains.worlds import location_of, register_domain

__all__ = [
    "ACTION_NAMES",
    "CELL_KINDS",
    "DISCOUNT",
    "EMPTY",
    "FORWARD",
    "GOAL",
    "LEFT",
    "MOST_MAPS",
    "OUTCOMES",
    "RIGHT",
    "STAY",
    "TASKS",
    "UNSEEN",
    "WALL",
    "BatchedEnvironment",
    "Domain",
    "DomainError",
    "DomainSpec",
    "ObservationPolicy",
    "OraclePolicy",
    "OracleResult",
    "PredicateVocabulary",
    "RecordedSteps",
    "StepRecorder",
    "Symmetries",
    "Symmetry",
    "ViewGeometry",
    "Weighting",
    "completed",
    "load_domain",
    "location_of",
    "register_domain",
    "symmetries_of",
]


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


def load_domain(name: str = "person_following") -> Domain:
    """The domain of a name: a registered one, or `package.module:ATTRIBUTE`; imported on first use.

    A module is also looked for in the current folder. What the domain may leave out is filled in (`completed`).

    Raises:
        DomainError: no domain of that name, it cannot be imported, or what is there is no domain.
    """
    return completed(worlds.found(name))


def completed(domain: Any) -> Domain:
    """The domain with what it leaves out filled in (see `domains.defaults`)."""
    full: Domain = defaults.completed(domain)
    return full
