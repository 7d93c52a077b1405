"""The Domain object of person following: what `load_domain("person_following")` returns."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.core import (
    FORWARD,
    LEFT,
    RIGHT,
    STAY,
    DomainSpec,
    OracleResult,
    RecordedSteps,
    Symmetry,
    ViewGeometry,
)
from domains.person_following.experts import LastSeenFollower
from domains.person_following.metrics import belief_metrics, episode_metrics
from domains.person_following.oracles.enumeration import all_maps, all_transitions, all_views
from domains.person_following.predicates import ViewPredicates
from domains.person_following.variants import DISCOUNTS, VARIANTS, Parameters, parameters_of
from domains.person_following.vector_env import PersonFollowingVectorEnv


class PersonFollowing:
    """The domain of the paper and its variants."""

    # The paper's model of the view is one of the world, not of where the experts that collected experience walked.
    spec = DomainSpec(name="person_following", variants=tuple(VARIANTS), discounts=DISCOUNTS, weighting="maps")
    symmetries = (Symmetry("mirror image", (RIGHT, LEFT, FORWARD, STAY), lambda views: views[:, ::-1]),)
    """The mirror image of a map about its diagonal is a map as likely, and left and right change places in it."""

    @property
    def predicates(self) -> ViewPredicates:
        """The observable predicates of a 5 x 5 view."""
        return self.predicates_of(self.spec.geometry)

    @staticmethod
    def predicates_of(geometry: ViewGeometry) -> ViewPredicates:
        """The observable predicates of views of another size."""
        return ViewPredicates(geometry)

    def make(
        self,
        task: str,
        num_envs: int,
        variant: str = "paper",
        seed: int | None = None,
        maps: NDArray[np.uint8] | None = None,
        cycle: bool = False,
        **parameters: Any,
    ) -> PersonFollowingVectorEnv:
        """A batched environment; see `domains.core.Domain.make`."""
        env = PersonFollowingVectorEnv(
            num_envs=num_envs, task=task, variant=variant, maps=maps, cycle=cycle, **parameters
        )
        env.pending_seed = seed
        return env

    def maps(self, variant: str = "paper", **parameters: Any) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The distinct maps as generated, sorted, and the generator's probabilities."""
        grids, weights = _maps(variant, tuple(sorted(parameters.items())))
        return grids.copy(), weights.copy()

    def views(self, variant: str = "paper", task: str = "following", **parameters: Any) -> NDArray[np.uint8]:
        """All distinct views over maps and poses, sorted; person following adds those of the freed cell."""
        grids, _ = _maps(variant, tuple(sorted(parameters.items())))
        return all_views(grids, parameters_of(variant, task, **parameters), following=task == "following")

    def transitions(
        self, variant: str = "paper", task: str = "following", **parameters: Any
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.uint8]]:
        """Every step from every pose of every map: map index, view, action, next view."""
        grids, _ = _maps(variant, tuple(sorted(parameters.items())))
        return all_transitions(grids, parameters_of(variant, task, **parameters), following=task == "following")

    def optimum(self, variant: str = "paper", discount: float | None = None, **parameters: Any) -> OracleResult:
        """The exact full-state optimum over the maps of a variant, weighted as the generator draws them."""
        from domains.person_following.oracles.full_state import full_state_optimum

        grids, weights = _maps(variant, tuple(sorted(parameters.items())))
        rules = parameters_of(variant, **parameters)
        return full_state_optimum(grids, weights, rules, self._discount(variant, discount))

    def bayes_optimum(self, variant: str = "paper", discount: float | None = None, **parameters: Any) -> OracleResult:
        """The exact optimum of an agent that knows the set of worlds, and sees only its observations."""
        from domains.person_following.oracles.history_policies import bayes_optimum

        return bayes_optimum(*self._worlds_of(variant, parameters), self._discount(variant, discount))

    def egocentric_optimum(
        self, variant: str = "paper", discount: float | None = None, **parameters: Any
    ) -> OracleResult:
        """The same for an agent in whose model of the person nobody is ever mistaken, played in the true task."""
        from domains.person_following.oracles.history_policies import egocentric_optimum

        return egocentric_optimum(*self._worlds_of(variant, parameters), self._discount(variant, discount))

    def last_seen_follower(self, num_envs: int, variant: str = "paper", **parameters: Any) -> LastSeenFollower:
        """A greedy follower of the person's last seen configuration, for B environments."""
        return LastSeenFollower(num_envs, parameters_of(variant, **parameters))

    def _discount(self, variant: str, given: float | None) -> float:
        return self.spec.discount(variant) if given is None else given

    @staticmethod
    def _worlds_of(
        variant: str, parameters: dict[str, Any]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64], Parameters]:
        rules = parameters_of(variant, **parameters)
        return *_maps(variant, tuple(sorted(parameters.items()))), rules

    @staticmethod
    def episode_metrics(steps: RecordedSteps, variant: str = "paper", **parameters: Any) -> dict[str, NDArray[Any]]:
        """Every metric of every finished episode; see `domains.core.Domain.episode_metrics`."""
        rules = parameters_of(variant, **parameters)
        return episode_metrics(steps, rules.follow_distance, rules.robot_rest)

    belief_metrics = staticmethod(belief_metrics)


@lru_cache(maxsize=16)
def _maps(variant: str, parameters: tuple[tuple[str, Any], ...]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    return all_maps(parameters_of(variant, **dict(parameters)))


DOMAIN = PersonFollowing()
