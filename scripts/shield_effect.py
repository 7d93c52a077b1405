"""What a shield costs and what it prevents: "never walk into the person or a wall", for the DQN and for a planner.

The DQN is trained with the rules and without; both act with the rules and without. The planner (our own search) acts
with and without. Forbidden actions are counted on the true view and configuration, not on what the shield was told:
`forward` with a wall in the cell ahead, or with the person there. Steps of training count besides those of the
evaluation. Differences are paired (the same maps and seeds for all); intervals are bootstrapped over episodes.

    python scripts/shield_effect.py --run runs/demo --steps 100000
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from domains.core import FORWARD, WALL, Domain, load_domain
from nesy.cli import configuration
from nesy.progress import ConsoleProgress
from nesy.run_folder import RunFolder
from nesy.world_model import SymbolicCodec, load_world_model
from planners.agents import Agent, DQNAgent
from planners.comparison.evaluation import Player, evaluate
from planners.comparison.statistics import bootstrap
from planners.config import DQNConfig, SearchConfig
from planners.dqn.dqn import Training, train
from planners.perception import Perception
from planners.person_following.agent import PlanningAgent
from planners.person_following.ialm import IALM
from planners.shielding import ShieldMask

RULES = """\
forbidden(forward) :- now(wall_ahead).
forbidden(forward) :- now(person_ahead).
"""


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """The run folder, with a world model and an IALM."""
    rules: Path | None = None
    """A rule file in place of "never walk into the person or a wall"."""
    steps: int = 100_000
    """Steps that the shielded agents take, at least."""
    unshielded_episodes: int = 840
    """Episodes of the planner without shield."""
    episodes: int = 6000
    """Training episodes of the DQN."""
    simulations: int = 300
    """Simulations per decision of the planner."""
    influence: str = "perspective-shift"
    """Influence mode of all of them."""
    seed: int = 0
    """Seed of everything random."""
    agents: tuple[str, ...] = ("dqn", "search")
    """Which agents."""
    output: Path | None = None
    """A JSON file for the figures."""


class Watched(Player):
    """A player whose forbidden actions are counted."""

    def __init__(self, player: Player, watch: Watch) -> None:
        super().__init__(player.agent, player.perception, player.mask, player.codec)
        self.watch = watch

    def decide(self, env: Any, observation: Any, active: np.ndarray, last: np.ndarray | None) -> Any:
        """As the player does."""
        actions, percepts = super().decide(env, observation, active, last)
        self.watch.see(observation, actions, active)
        return actions, percepts


class Watch:
    """Counts steps, and those into a wall or the person."""

    def __init__(self, domain: Domain) -> None:
        geometry = domain.spec.geometry
        self.cell = (geometry.viewer[0], geometry.viewer[1] - 1)
        self.ahead = {int(geometry.encode(*self.cell, heading)) for heading in range(4)}
        self.steps = self.into_walls = self.into_person = 0

    def see(self, observation: Any, actions: np.ndarray, active: np.ndarray) -> None:
        """One step of a batch."""
        moving = active & (actions == FORWARD)
        self.steps += int(active.sum())
        self.into_walls += int((moving & (observation["view"][:, self.cell[0], self.cell[1]] == WALL)).sum())
        self.into_person += int((moving & np.isin(observation["configuration"], list(self.ahead))).sum())


def main() -> None:
    """Train, act, count, and print one table."""
    options = tyro.cli(Arguments, description=__doc__)
    run = RunFolder.open(options.run)
    domain = load_domain(configuration.load(run.config).domain)
    codec = SymbolicCodec(load_world_model(run.world_model))
    rules: list[str | Path] = [RULES if options.rules is None else options.rules]
    mask = ShieldMask(rules, codec, domain)
    progress = ConsoleProgress()
    results: dict[str, dict[str, Any]] = {}
    returns: dict[str, np.ndarray] = {}

    def play(name: str, agent: Callable[[int], Agent], shielded: bool, least_steps: int, episodes: int) -> None:
        perception = Perception(codec, options.influence, np.random.default_rng([options.seed, 1]))
        watch = Watch(domain)
        parts: list[dict[str, np.ndarray]] = []
        while watch.steps < least_steps or 168 * len(parts) < episodes:
            seed = options.seed + len(parts)
            player = Watched(Player(agent(seed), perception, mask if shielded else None), watch)
            parts.append(evaluate(domain, "paper", player, 168, seed))
        gains = np.concatenate([part["return"] for part in parts])
        success = np.concatenate([part["outcome"] for part in parts]) == domain.spec.outcomes.index("success")
        returns[name], returns[name + "/success"] = gains, success.astype(float)
        results[name] = {
            "steps": watch.steps,
            "into_walls": watch.into_walls,
            "into_person": watch.into_person,
            "episodes": len(gains),
            "return": _interval(gains, options.seed),
            "success": _interval(success.astype(float), options.seed),
        }
        print(json.dumps({name: results[name]}), flush=True)

    if "dqn" in options.agents:
        for trained, training_mask in (("free", None), ("shielded", mask)):
            watch = Watch(domain)
            training = Training(
                _watched(domain, watch),
                codec,
                "full",
                options.influence,
                "paper",
                DQNConfig.fast(options.episodes),
                options.seed,
                training_mask,
            )
            policy, columns = train(training, progress)
            results[f"dqn training {trained}"] = {
                "steps": watch.steps,
                "into_walls": watch.into_walls,
                "into_person": watch.into_person,
                "episodes": len(columns["return"]),
            }
            print(json.dumps({f"dqn training {trained}": results[f"dqn training {trained}"]}), flush=True)
            for acting in (False, True):
                name = f"dqn trained {trained}, acting {'shielded' if acting else 'free'}"
                play(name, lambda seed, policy=policy: DQNAgent(policy), acting, options.steps, 0)
    if "search" in options.agents:
        model = IALM.load(run.ialm)
        config = SearchConfig(simulations=options.simulations)

        def planner(seed: int) -> Agent:
            # random streams of its own in every part: the same maps come again
            return PlanningAgent("search", model, config, domain.spec.geometry, seed)

        for shielded in (False, True):
            name = f"search acting {'shielded' if shielded else 'free'}"
            play(name, planner, shielded, options.steps if shielded else 0, options.unshielded_episodes)
    pairs = (
        ("dqn trained free, acting free", "dqn trained free, acting shielded"),
        ("dqn trained free, acting free", "dqn trained shielded, acting shielded"),
        ("search acting free", "search acting shielded"),
    )
    for free, kept in pairs:
        if free in returns and kept in returns:
            results[f"{kept} minus {free}"] = {
                figure: _interval(_paired(returns[kept + suffix], returns[free + suffix]), options.seed)
                for figure, suffix in (("return", ""), ("success", "/success"))
            }
            print(json.dumps({f"{kept} minus {free}": results[f"{kept} minus {free}"]}), flush=True)
    results["conflicts"] = {"situations": sum(mask.conflicts.values())}
    if options.output is not None:
        options.output.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def _paired(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    count = min(len(one), len(other))
    return one[:count] - other[:count]


def _interval(values: np.ndarray, seed: int) -> dict[str, float | None]:
    found = bootstrap(values, seed).as_dict()
    return {name: None if value is None else round(value, 4) for name, value in found.items()}


class _WatchedEnvironment:
    """A batched environment whose steps are counted."""

    def __init__(self, env: Any, watch: Watch) -> None:
        self._env, self._watch = env, watch
        self._observation: dict[str, np.ndarray] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, **options: Any) -> Any:
        """As the environment does."""
        observation, infos = self._env.reset(**options)
        self._observation = {name: np.array(value) for name, value in observation.items()}
        return observation, infos

    def step(self, actions: np.ndarray) -> Any:
        """As the environment does."""
        self._watch.see(self._observation, np.asarray(actions), np.ones(len(actions), np.bool_))
        observation, *rest = self._env.step(actions)
        self._observation = {name: np.array(value) for name, value in observation.items()}
        return (observation, *rest)


def _watched(domain: Domain, watch: Watch) -> Any:
    """The domain, with environments whose steps are counted."""

    class Watching:
        def __getattr__(self, name: str) -> Any:
            return getattr(domain, name)

        def make(self, *arguments: Any, **keywords: Any) -> Any:
            return _WatchedEnvironment(domain.make(*arguments, **keywords), watch)

    return Watching()


if __name__ == "__main__":
    main()
