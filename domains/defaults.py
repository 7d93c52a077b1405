"""What a world may leave out, and what stands in its place.

    of a domain          maps, views, transitions, the oracles, last_seen_follower: asked for, they refuse in one line,
                         as a domain does that has them for other variants only; episode_metrics: return, length and
                         outcome; belief_metrics: none
    of an environment    close, person_minds, counters; and in a task without a person all that is about one: never in
                         view, nowhere, and it does nothing

So nothing else needs to ask what is there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from domains.recording import FinishedEpisodes, RecordedSteps
from domains.vocabulary import STAY, UNSEEN, DomainError, DomainSpec

REFUSED = {
    "maps": "its maps cannot be listed",
    "views": "its views cannot be listed",
    "transitions": "its transitions cannot be listed",
    "optimum": "it has no exact optimum",
    "bayes_optimum": "it has no exact optimum of an agent that sees in part",
    "egocentric_optimum": "it has no exact optimum of an egocentric agent",
    "last_seen_follower": "it has no follower of the last seen configuration",
}
"""Members of a domain that refuse where they are left out, with what they say."""
OPTIONAL = (*REFUSED, "episode_metrics", "belief_metrics")
"""Members that a domain may leave out."""
ABOUT_A_PERSON = ("person_views", "relative_poses", "person_actions")
"""Members of an environment that it may leave out in a task without a person."""
NEVER_NEEDED = ("person_minds", "counters", "close")
"""Members of an environment that it may always leave out."""


def completed(domain: Any) -> Any:
    """The domain with stand-ins for what it and its environments leave out."""
    return domain if isinstance(domain, _Completed) else _Completed(domain)


class _Completed:
    """A domain whose optional members are all there."""

    def __init__(self, world: Any) -> None:
        self.world = world
        self.spec: DomainSpec = world.spec

    def __getattr__(self, name: str) -> Any:
        """The domain's own member, or its stand-in."""
        if name == "world":  # not made yet: an unpickled or copied object asks before it has anything
            raise AttributeError(name)
        if name not in OPTIONAL or callable(getattr(self.world, name, None)):
            return getattr(self.world, name)
        if name == "episode_metrics":
            return plain_metrics
        if name == "belief_metrics":
            return lambda *_, **__: {}

        def refuse(*_: Any, **__: Any) -> Any:
            raise DomainError(f"world '{self.spec.name}': {REFUSED[name]}")

        return refuse

    def make(self, task: str, num_envs: int, *arguments: Any, **parameters: Any) -> Any:
        """The domain's environment; completed, where it leaves something out."""
        env = self.world.make(task, num_envs, *arguments, **parameters)
        lacking = [name for name in ABOUT_A_PERSON + NEVER_NEEDED if not callable(getattr(env, name, None))]
        if not lacking or (task == "following" and lacking[0] in ABOUT_A_PERSON):
            return env  # complete, or without what it may not leave out: `check_domain` says so
        return _CompletedEnvironment(env, self.spec, task == "following")


class _CompletedEnvironment:
    """An environment whose optional members, observations and infos are all there."""

    def __init__(self, env: Any, spec: DomainSpec, person: bool) -> None:
        self.env, self.num_envs, self._width = env, int(env.num_envs), spec.geometry.view_size
        self._person = person

    def __getattr__(self, name: str) -> Any:
        """What else the environment has."""
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the environment's own; nobody is seen where it does not say."""
        observation, infos = self.env.reset(seed=seed, options=options)
        return self._observation(observation), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As the environment's own, with all infos."""
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        count, infos = self.num_envs, dict(infos)
        infos.setdefault("final_counters", np.zeros((count, 2), np.int16))
        if self._person:
            return observation, reward, terminated, truncated, infos
        observation = self._observation(observation)
        infos["final_obs"] = self._observation(infos["final_obs"])
        infos.setdefault("distance", np.zeros(count, np.int64))
        infos.setdefault("visible", infos["final_obs"]["configuration"] > 0)
        infos.setdefault("person_action", np.full(count, -1, np.int8))
        infos.setdefault("person_waited", np.asarray(infos["person_action"]) == STAY)
        infos.setdefault("final_person_view", self._unseen())
        infos.setdefault("final_relative_pose", np.zeros((count, 3), np.int16))
        return observation, reward, terminated, truncated, infos

    def _observation(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        return (
            dict(observation) if self._person else {"configuration": np.zeros(self.num_envs, np.int64), **observation}
        )

    def _unseen(self) -> NDArray[np.uint8]:
        return np.full((self.num_envs, self._width, self._width), UNSEEN, np.uint8)

    def _own(self, name: str, otherwise: NDArray[Any]) -> Any:
        own = getattr(self.env, name, None)
        return own() if callable(own) else otherwise

    def person_views(self) -> Any:
        """`[B, v, v]`."""
        return self._own("person_views", self._unseen())

    def relative_poses(self) -> Any:
        """`[B, 3]`."""
        return self._own("relative_poses", np.zeros((self.num_envs, 3), np.int16))

    def person_actions(self) -> Any:
        """`[B]`."""
        return self._own("person_actions", np.full(self.num_envs, -1, np.int8))

    def person_minds(self) -> Any:
        """`[B, 2, 2]`."""
        return self._own("person_minds", np.zeros((self.num_envs, 2, 2), np.int16))

    def counters(self) -> Any:
        """`[B, 2]`."""
        return self._own("counters", np.zeros((self.num_envs, 2), np.int16))

    def expert_actions(self, kind: str) -> Any:
        """`[B]`."""
        return self.env.expert_actions(kind)

    def map_ids(self) -> Any:
        """`[B]`."""
        return self.env.map_ids()

    def states(self) -> Any:
        """The full state of every environment."""
        return self.env.states()

    def close(self) -> None:
        """The environment's own, where it has one."""
        if callable(getattr(self.env, "close", None)):
            self.env.close()


def plain_metrics(steps: RecordedSteps, *_: Any, **__: Any) -> dict[str, NDArray[Any]]:
    """What can be said of every finished episode of any world; see `domains.core.Domain.episode_metrics`."""
    episodes = FinishedEpisodes(steps)
    return {**episodes.plain(), **episodes.extra()}
