"""Collecting experience: who acts, and the shards in which it is written.

A shard is one Parquet file with a fixed number of episodes of one source. Its random numbers depend on the seed,
the source and the number of the shard alone, so a finished shard is not collected again, and what is collected
does not depend on interruptions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from domains.core import TASKS, BatchedEnvironment, Domain, completed
from nesy.config import CollectConfig
from nesy.errors import UserError
from nesy.log.experience import SOURCES, count_rows, write_part
from nesy.progress import SILENT, Progress, Task

LEAD = 16
"""An exploring episode begins with fewer than this many steps of the expert, and walks at random from there."""
SWITCH = 0.2
"""Chance per step that the switching behaviour decides anew whether it acts at random or as the expert."""


@dataclass(frozen=True)
class Shard:
    """What one file holds."""

    index: int
    source: str
    number: int
    """Which shard of its source, from 0."""
    first_episode: int
    episodes: int

    @property
    def name(self) -> str:
        """The file's name."""
        return f"part-{self.index:05d}.parquet"


def plan(config: CollectConfig, tasks: Sequence[str] = TASKS) -> list[Shard]:
    """The shards that a configuration asks for in a world that has some tasks.

    Half of the crossing episodes are random and half by the expert. Of the following episodes a quarter is
    random, a quarter by the expert, and the rest switches between the two. As no episode of that task can look
    around far from the person, half as many again explore its maps without one. Episodes of a task that the world
    does not have are left out.

    Raises:
        UserError: nothing is left.
    """
    quarter = config.following_episodes // 4
    episodes = {
        "crossing-random": config.crossing_episodes // 2,
        "crossing-expert": config.crossing_episodes - config.crossing_episodes // 2,
        "crossing-explore": config.following_episodes // 2,
        "following-random": quarter,
        "following-expert": quarter,
        "following-mixture": config.following_episodes - 2 * quarter,
    }
    shards: list[Shard] = []
    done = 0
    for source in SOURCES:
        needed = TASKS if source == "crossing-explore" else source.split("-")[:1]
        if not set(needed) <= set(tasks):
            continue
        for number, first in enumerate(range(0, episodes[source], config.shard_episodes)):
            size = min(config.shard_episodes, episodes[source] - first)
            shards.append(Shard(len(shards), source, number, done, size))
            done += size
    if not shards:
        raise UserError(f"collect: no episodes to collect; set {' or '.join(f'{task}_episodes' for task in tasks)}")
    return shards


def collect(
    domain: Domain,
    config: CollectConfig,
    folder: Path | str,
    seed: int = 0,
    progress: Progress = SILENT,
    *,
    variant: str = "paper",
) -> int:
    """Collect what is still missing in `folder`.

    Args:
        domain: where to act.
        config: how much.
        folder: gets `part-*.parquet`.
        seed: of everything random.
        progress: where to report.
        variant: of the domain.

    Returns:
        The number of rows in all shards.
    """
    folder, domain = Path(folder), completed(domain)
    shards = plan(config, domain.spec.tasks)
    rows = 0
    with progress.task("collecting experience", sum(shard.episodes for shard in shards)) as task:
        for shard in shards:
            path = folder / shard.name
            finished = count_rows(path)
            if finished is None:
                finished = _collect_shard(domain, variant, config, shard, path, seed, task)
            else:
                task.advance(shard.episodes)
            rows += finished
    return rows


def collect_following(
    domain: Domain,
    episodes: int,
    mixture: float,
    folder: Path | str,
    seed: int = 0,
    progress: Progress = SILENT,
    *,
    variant: str = "paper",
) -> int:
    """Collect what is still missing of `episodes` more person-following episodes that switch behaviour.

    For who needs to know the person better than the world: a planner's tables. Arguments as in `collect`;
    `mixture` is the probability that the switching behaviour acts at random.

    Returns:
        The number of rows in all shards.
    """
    folder = Path(folder)
    config = CollectConfig(crossing_episodes=0, following_episodes=episodes, following_mixture=mixture)
    rows, done = 0, 0
    with progress.task("collecting practice", episodes) as task:
        while done < episodes:
            size = min(config.shard_episodes, episodes - done)
            # Numbered from 10,000: other random streams than the shards of `collect`.
            index = done // config.shard_episodes
            shard = Shard(index, "following-mixture", 10_000 + index, done, size)
            finished = count_rows(folder / shard.name)
            if finished is None:
                finished = _collect_shard(domain, variant, config, shard, folder / shard.name, seed, task)
            else:
                task.advance(size)
            rows += finished
            done += size
    return rows


def _collect_shard(
    domain: Domain, variant: str, config: CollectConfig, shard: Shard, path: Path, seed: int, task: Task
) -> int:
    sequence = np.random.SeedSequence([seed, SOURCES.index(shard.source), shard.number])
    environment_seed, policy_seed = sequence.spawn(2)
    rng = np.random.default_rng(policy_seed)
    task_name, behaviour = shard.source.split("-")
    num_envs = min(config.num_envs, shard.episodes)
    start = int(environment_seed.generate_state(1)[0] >> 1)
    if behaviour == "explore":
        env = domain.make(
            task_name, num_envs, variant=variant, seed=start, maps=_maps(domain, variant, shard, start), cycle=True
        )
    else:
        env = domain.make(task_name, num_envs, variant=variant, seed=start)
    num_actions = len(domain.spec.action_names)
    acting = _Behaviour(behaviour, task_name, config.following_mixture, num_envs, num_actions, rng)
    steps = _Steps(env, shard, acting, task)
    return write_part(path, {**steps.columns(), "source": np.full(steps.rows, shard.source)})


def _maps(domain: Domain, variant: str, shard: Shard, seed: int) -> np.ndarray:
    """Maps of the following task as its episodes play them, one per episode of the shard: uint8 [M, size, size]."""
    env = domain.make("following", shard.episodes, variant=variant, seed=seed)
    env.reset()
    return np.stack([state["grid"] for state in env.states()])


class _Behaviour:
    """Chooses actions: at random, as the expert, exploring, or switching between random and expert."""

    def __init__(
        self, name: str, task: str, mixture: float, num_envs: int, num_actions: int, rng: np.random.Generator
    ) -> None:
        self.name, self.mixture, self.num_actions, self.rng = name, mixture, num_actions, rng
        self.expert = "goal" if task == "crossing" else "follower"
        self.acts_randomly = rng.random(num_envs) < mixture
        self.lead = np.zeros(num_envs, dtype=np.int64)

    def actions(self, env: BatchedEnvironment, t: np.ndarray) -> np.ndarray:
        """Actions int64 [B] at steps `t` [B] of the episodes."""
        chosen = self.rng.integers(0, self.num_actions, env.num_envs)
        if self.name == "random":
            return chosen
        expert = env.expert_actions(self.expert)
        if self.name == "explore":
            self.lead = np.where(t == 0, self.rng.integers(0, LEAD, env.num_envs), self.lead)
            return np.where(t < self.lead, expert, chosen)
        if self.name == "expert":
            return expert
        switch = self.rng.random(env.num_envs) < SWITCH
        self.acts_randomly = np.where(switch, self.rng.random(env.num_envs) < self.mixture, self.acts_randomly)
        return np.where(self.acts_randomly, chosen, expert)


class _Steps:
    """Plays the episodes of a shard; environment i plays episodes i, i + B, i + 2B, ..."""

    def __init__(self, env: BatchedEnvironment, shard: Shard, behaviour: _Behaviour, task: Task) -> None:
        self.parts: list[dict[str, np.ndarray]] = []
        observation, _ = env.reset()
        episode = np.arange(env.num_envs)
        t = np.zeros(env.num_envs, dtype=np.int32)
        while (playing := episode < shard.episodes).any():
            before = self._before(env, observation)
            action = behaviour.actions(env, t)
            map_id = env.map_ids()
            observation, reward, terminated, truncated, infos = env.step(action)
            if shard.source.startswith("crossing"):
                person_after = {
                    "next_relative_pose": before["relative_pose"],
                    "next_person_view": before["person_view"],
                }
            else:
                person_after = {
                    "next_relative_pose": infos["final_relative_pose"],
                    "next_person_view": infos["final_person_view"],
                }
            row = {
                "episode": shard.first_episode + episode,
                "t": t,
                "map_id": map_id,
                **before,
                "action": action,
                "person_action": infos["person_action"],
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
                "outcome": infos["outcome_code"],
                "distance": infos["distance"],
                "visible": infos["visible"],
                "next_view": infos["final_obs"]["view"],
                "next_configuration": infos["final_obs"]["configuration"],
                **person_after,
            }
            self.parts.append({name: np.array(values[playing]) for name, values in row.items()})
            ended = terminated | truncated
            task.advance(int((ended & playing).sum()))
            episode = np.where(ended, episode + env.num_envs, episode)
            t = np.where(ended, 0, t + 1).astype(np.int32)

    @staticmethod
    def _before(env: BatchedEnvironment, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        counters = env.counters()
        return {
            "view": observation["view"],
            "configuration": observation["configuration"],
            "relative_pose": env.relative_poses(),
            "waiting": counters[:, 0],
            "lost": counters[:, 1],
            "person_view": env.person_views(),
        }

    @property
    def rows(self) -> int:
        """Number of steps."""
        return sum(len(part["action"]) for part in self.parts)

    def columns(self) -> dict[str, np.ndarray]:
        """All columns but `source`, episode after episode."""
        columns = {name: np.concatenate([part[name] for part in self.parts]) for name in self.parts[0]}
        order = np.lexsort((columns["t"], columns["episode"]))
        return {name: values[order] for name, values in columns.items()}
