"""What b~ tells under each way of making it, and what a policy of input set `paper` learns to do with it.

    python scripts/influence_information.py --run runs/demo
    python scripts/influence_information.py --run runs/demo --episodes 5000 --jobs 2 --output runs/information.json

First how much is left open, in bits, to who knows b and b~: of the configuration (whether the person is in view, and
where), of the configuration while the person is in view, and of the greedy follower's next action then. Steps of a
mixture of that follower and random actions. Plug-in estimates from joint counts where b~ is a function of the
situation (beliefs count as the same if they agree to three digits); for samples of b~ the posterior of every
configuration, by Bayes' rule from the samples' densities, averaged over the steps.

Then how much of it is easily read: the bits of the configuration (whether the person is in view, and where), of
whether it is in view at all, and of the follower's next action that a network like the DQN's leaves open after as few
updates as a training has, on steps of other environments (Xu et al., "A theory of usable information under
computational constraints", ICLR 2020). What is in b~ for an ideal observer may still be hard to read.

With --episodes also what is learned from each, mean return of the last tenth of the training episodes with 95 %
intervals over seeds, and the same with the configuration told (input set `full`).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import nn

from domains.core import load_domain
from nesy.perspective.operator import InfluenceBelief, PerspectiveShift
from nesy.report.text import interval
from nesy.run_folder import RunFolder, read_json, write_json
from nesy.world_model import SymbolicCodec, load_world_model
from planners.comparison.statistics import over_seeds
from planners.config import DQNConfig
from planners.dqn.dqn import Training, ValueNetwork, train
from planners.dqn.published import TEMPERATURE, dqn_perception
from planners.perception import Codec, Perception, Percepts

HEADINGS = 4
PLAIN = DQNConfig.fast()


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """A run with a trained world model."""
    steps: int = 400
    """Batched steps of 256 environments that the bits are estimated from."""
    mixture: float = 0.3
    """Probability of a random action."""
    seed: int = 0
    """Seed of these steps."""
    updates: int = 1000
    """Updates of the network that reads the configuration from b and b~."""
    episodes: int = 0
    """Training episodes; 0 to measure the bits alone."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    ways: tuple[str, ...] = ()
    """Which ways are measured and learned; all by default."""
    told: tuple[str, ...] = ("random", "perspective-shift", "perfect-information")
    """Ways that are learned with the configuration told besides."""
    jobs: int = 1
    """Processes."""
    output: Path = Path("runs/influence_information.json")
    """Where the returns are kept; trainings that it holds are not repeated."""


class Marked(Perception):
    """The true code also while the person is out of view, but believed by half there, so that it shows at a glance."""

    def __init__(self, codec: Codec, rng: np.random.Generator) -> None:
        super().__init__(codec, "perfect-information", rng)
        self._shift = InfluenceBelief("perfect-information", codec, rng, even_unseen=True)

    def __call__(self, observation: dict[str, np.ndarray], person_views: np.ndarray) -> Percepts:
        """Percepts of observations `view` [B, V, V] and `configuration` [B]."""
        percepts = super().__call__(observation, person_views)
        blurred = (percepts.shifted + np.float32(1.0 / percepts.shifted.shape[-1])) / 2
        seen = (percepts.configurations > 0)[:, None, None]
        return percepts._replace(shifted=np.where(seen, percepts.shifted, blurred))


class Altered(Perception):
    """Φ with something taken out of b~ while the person is in view."""

    def __init__(self, alteration: str, codec: Codec, influence: str, rng: np.random.Generator) -> None:
        super().__init__(codec, influence, rng)
        self.alteration = alteration
        network = alteration == "factored" or codec.packed() is None
        self.phi = PerspectiveShift(codec, "network" if network else "table")

    def __call__(self, observation: dict[str, np.ndarray], person_views: np.ndarray) -> Percepts:
        """Percepts of observations `view` [B, V, V] and `configuration` [B]."""
        percepts = super().__call__(observation, person_views)
        count, configurations = len(percepts.codes), percepts.configurations
        if self.alteration == "heading averaged out":
            first = np.where(configurations > 0, (configurations - 1) // HEADINGS * HEADINGS + 1, 0)
            every = np.where(first > 0, first + np.arange(HEADINGS)[:, None], 0)
            found = self.phi(np.concatenate([percepts.beliefs] * HEADINGS), every.reshape(-1))
            there = found.reachable.reshape(HEADINGS, count, 1, 1)
            total = (found.beliefs.reshape(HEADINGS, *percepts.beliefs.shape) * there).sum(axis=0)
            shifted = np.where(there.any(axis=0), total / np.maximum(there.sum(axis=0), 1), percepts.shifted)
        elif self.alteration == "likeliest code":
            found = self.phi(percepts.beliefs, configurations)
            certain = np.eye(self.codec.num_values, dtype=np.float32)[found.codes]
            shifted = np.where(found.reachable[:, None, None], certain, percepts.shifted)
        else:
            shifted = self.phi(percepts.beliefs, configurations).beliefs
        return percepts._replace(shifted=shifted.astype(np.float32))


Make = Callable[[Codec, np.random.Generator], Perception]


def _mode(influence: str, **switches: Any) -> Make:
    return lambda codec, rng: dqn_perception(codec, influence, rng, replace(PLAIN, **switches))


def _altered(alteration: str) -> Make:
    return lambda codec, rng: Altered(alteration, codec, "perspective-shift", rng)


WAYS: dict[str, tuple[str, Make]] = {
    "zero": ("zero", _mode("zero")),
    "random": ("random", _mode("random")),
    "egocentric": ("egocentric", _mode("egocentric")),
    "perspective-shift": ("perspective-shift", _mode("perspective-shift")),
    "perspective-shift, factored roll-out": ("perspective-shift", _altered("factored")),
    "perspective-shift, likeliest code": ("perspective-shift", _altered("likeliest code")),
    "perspective-shift, heading averaged out": ("perspective-shift", _altered("heading averaged out")),
    "perspective-shift, sampled": ("perspective-shift", _mode("perspective-shift", published_sampling=True)),
    "perfect-information": ("perfect-information", _mode("perfect-information")),
    "perfect-information, no looking through walls": (
        "perfect-information",
        _mode("perfect-information", published_occlusion=True),
    ),
    "perfect-information, also out of view": ("perfect-information", _mode("perfect-information", fallback="mode")),
    "perfect-information, also out of view, marked": ("perfect-information", Marked),
}
SAMPLED = ("random", "perspective-shift, sampled")
"""Ways whose b~ is no function of the situation."""


def main(options: Arguments) -> None:
    """Measure, learn what is missing, and print the table."""
    bits = information(options)
    returns = learned(options) if options.episodes else {}
    columns = ["configuration", "in view", "next action in view"]
    columns += [f"{what}, to a network" for what in ("configuration", "in view or not", "next action")] + [
        "distinct b~"
    ]
    if returns:
        columns += [f"return, {options.episodes} episodes", "return, configuration told"]
    print(f"| b~ | {' | '.join(columns)} |\n|{' --- |' * (len(columns) + 1)}")
    for way, (*figures, distinct) in bits.items():
        cells = [*(f"{figure:.2f}" for figure in figures), f"{distinct:.0f}" if distinct else ""]
        cells += [returns.get((way, inputs), "") for inputs in ("paper", "full")] if returns else []
        print(f"| {way} | {' | '.join(cells)} |")


def information(options: Arguments) -> dict[str, tuple[float, ...]]:
    """For each way: bits left open of the three, and by a network of the configuration, whether there is one, and the
    follower's next action; the number of different b~ (0: not counted).
    """  # noqa: D205
    domain = load_domain()
    codec: Any = SymbolicCodec(load_world_model(RunFolder(options.run).world_model))
    rng = np.random.default_rng(options.seed)
    needed = ("perspective-shift",) if SAMPLED[1] in options.ways else ()
    chosen = {way: WAYS[way] for way in dict.fromkeys([*(options.ways or WAYS), *needed])}
    ways = {way: make(codec, np.random.default_rng([options.seed, 1])) for way, (_, make) in chosen.items()}
    env: Any = domain.make("following", 256, seed=options.seed)
    observation, _ = env.reset(seed=options.seed)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("configuration", "action", "code", "b~", *ways)}
    for _ in range(options.steps):
        expert = np.asarray(env.expert_actions("follower"))
        for way, perception in ways.items():
            percepts = perception(observation, env.person_views())
            rows[way].append(np.round(percepts.shifted.reshape(256, -1) * 1000).astype(np.int16))
            if way == "perspective-shift":
                rows["b~"].append(percepts.shifted)
        rows["configuration"].append(percepts.configurations)
        rows["action"].append(expert)
        rows["code"].append(percepts.codes.astype(np.int16))
        action = np.where(rng.random(256) < options.mixture, rng.integers(4, size=256), expert)
        observation, *_ = env.step(action)
    data = {name: np.concatenate(parts) for name, parts in rows.items() if parts}
    code, configuration, seen = data["code"], data["configuration"], data["configuration"] > 0
    found: dict[str, tuple[float, ...]] = {}
    own = np.eye(codec.num_values, dtype=np.float32)[code].reshape(len(code), -1)
    for way in chosen:
        known = [code, seen[:, None].astype(np.int16) if way in SAMPLED else data[way]]
        exact = (
            conditional_entropy(configuration, known),
            conditional_entropy(configuration[seen], [part[seen] for part in known]),
            conditional_entropy(data["action"][seen], [part[seen] for part in known]),
        )
        if way == "perspective-shift, sampled":
            exact = _sampled(data, rng)
        inputs = np.concatenate([own, data[way].astype(np.float32) / 1000], axis=1)
        wanted = (configuration, (configuration > 0).astype(np.int64), data["action"])
        read = (read_by_network(inputs, each, options) for each in wanted)
        found[way] = (*exact, *read, 0 if way in SAMPLED else len({row.tobytes() for row in data[way]}))
    print(f"{len(seen)} steps, {seen.sum()} of them with the person in view")
    return found


def read_by_network(inputs: np.ndarray, target: np.ndarray, options: Arguments) -> float:
    """Bits of `target` that a network leaves open, which learned from three quarters of the environments."""
    generator = torch.Generator().manual_seed(options.seed)
    torch.manual_seed(options.seed)
    test = torch.from_numpy(np.arange(len(inputs)) % 256 >= 192)
    given, wanted = torch.from_numpy(inputs), torch.from_numpy(target)
    network = ValueNetwork(inputs.shape[1], int(target.max()) + 1, replace(PLAIN, dueling=False))
    optimiser = torch.optim.Adam(network.parameters(), lr=PLAIN.learning_rate)
    practice = torch.nonzero(~test).squeeze(1)
    for _ in range(options.updates):
        batch = practice[torch.randint(len(practice), (PLAIN.batch_size,), generator=generator)]
        loss = nn.functional.cross_entropy(network(given[batch]), wanted[batch])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        return float(nn.functional.cross_entropy(network(given[test]), wanted[test])) / np.log(2)


def conditional_entropy(target: np.ndarray, given: list[np.ndarray]) -> float:
    """H(target | given) in bits, from joint counts; every array has one row per step."""
    known = _numbered(np.concatenate([part.reshape(len(target), -1) for part in given], axis=1))
    pairs, counts = np.unique(np.stack([known, target]), axis=1, return_counts=True)
    of_known = np.bincount(known)[pairs[0]]
    return float((counts / len(target) * np.log2(of_known / counts)).sum())


def _numbered(rows: np.ndarray) -> np.ndarray:
    """A number for each distinct row, int64 [n]."""
    numbers: dict[bytes, int] = {}
    rows = np.ascontiguousarray(rows)
    return np.array([numbers.setdefault(row.tobytes(), len(numbers)) for row in rows])


def _sampled(data: dict[str, np.ndarray], rng: np.random.Generator) -> tuple[float, float, float]:
    """Bits left open by one relaxed sample of Φ's b~ per step."""
    seen = data["configuration"] > 0
    code, configuration, action = _numbered(data["code"][seen]), data["configuration"][seen], data["action"][seen]
    beliefs = data["b~"][seen].astype(np.float64)
    open_configuration, open_action = np.zeros(len(code)), np.zeros(len(code))
    for here in range(code.max() + 1):
        rows = np.flatnonzero(code == here)
        places, first, place, counts = np.unique(
            configuration[rows], return_index=True, return_inverse=True, return_counts=True
        )
        possible = beliefs[rows[first]]  # b~ is a function of code and configuration
        with np.errstate(divide="ignore"):
            log = np.log(possible)
            samples = (log[place] + rng.gumbel(size=log[place].shape)) / TEMPERATURE
        samples -= np.log(np.exp(samples).sum(axis=-1, keepdims=True))
        likelihood = np.stack([_log_density(samples, log[k]) for k in range(len(places))], axis=1)
        posterior = np.exp(likelihood - likelihood.max(axis=1, keepdims=True)) * counts
        posterior /= posterior.sum(axis=1, keepdims=True)
        open_configuration[rows] = -np.log2(posterior[np.arange(len(rows)), place])
        chances = np.zeros((len(places), 4))
        np.add.at(chances, (place, action[rows]), 1.0)
        of_action = posterior @ (chances / counts[:, None])
        open_action[rows] = -np.log2(of_action[np.arange(len(rows)), action[rows]])
    return float(open_configuration.sum() / len(seen)), float(open_configuration.mean()), float(open_action.mean())


def _log_density(samples: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Log density of relaxed samples, given by their logarithms [n, N, K], of a belief's logarithm [N, K], up to what
    the samples alone decide: Maddison et al., "The concrete distribution", 2017, equation 10.
    """  # noqa: D205
    possible = np.isfinite(log)
    agree = (np.isfinite(samples) == possible).all(axis=(1, 2))
    with np.errstate(invalid="ignore"):  # where they do not agree, nothing of this counts
        terms = np.where(possible, log - TEMPERATURE * samples, -np.inf)
        top = terms.max(axis=-1, keepdims=True)
        total = (top + np.log(np.exp(terms - top).sum(axis=-1, keepdims=True)))[..., 0]
    value = np.where(possible, log, 0.0).sum() - (possible.sum(axis=-1) * total).sum(axis=-1)
    return np.where(agree, value, -np.inf)


def learned(options: Arguments) -> dict[tuple[str, str], str]:
    """Return of the last tenth of the training episodes, as text, by way and input set."""
    tasks = [(way, "paper") for way in options.ways or WAYS] + [(way, "full") for way in options.told]
    kept: dict[str, float] = read_json(options.output) if options.output.is_file() else {}
    missing = {
        (way, inputs, seed): f"{way} / {inputs} / {options.episodes} episodes / seed {seed}"
        for seed in options.seeds
        for way, inputs in tasks
        if f"{way} / {inputs} / {options.episodes} episodes / seed {seed}" not in kept
    }
    work = partial(_learn, options.run, options.episodes)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(work, *task): name for task, name in missing.items()}
        for future in as_completed(futures):
            kept[futures[future]] = future.result()
            write_json(options.output, kept)
            print(f"{futures[future]}: {future.result():.1f}", flush=True)
    found = {}
    for way, inputs in tasks:
        values = [kept[f"{way} / {inputs} / {options.episodes} episodes / seed {seed}"] for seed in options.seeds]
        spread = over_seeds(np.array(values), np.array(options.seeds), 0)
        found[way, inputs] = interval(spread.as_dict(), 1)
    return found


def _learn(run: Path, episodes: int, way: str, inputs: str, seed: int) -> float:
    codec: Any = SymbolicCodec(load_world_model(RunFolder(run).world_model))
    mode, make = WAYS[way]
    perception = make(codec, np.random.default_rng([seed, 2]))
    config = DQNConfig.fast(episodes)
    training = Training(load_domain(), codec, inputs, mode, "paper", config, seed, perception=perception)
    _, columns = train(training)
    return float(columns["return"][-max(episodes // 10, 1) :].mean())


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
