"""What b~ tells under each influence mode, and so what input set `paper` can be expected to learn from it.

Steps of a mixture of the greedy follower and random actions; only those in which the person is in view. In bits:
how much of the person's configuration (its place and heading relative to the robot) and of the follower's next
action is still unknown to who knows b alone, and to who knows b and b~; plug-in estimates, so only for modes whose b~
is a function of the situation. Beliefs count as the same if they agree to three digits.

    python scripts/influence_information.py --run runs/demo
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from domains.core import load_domain
from nesy.perspective import PerspectiveShift
from nesy.run_folder import RunFolder
from nesy.world_model import SymbolicCodec, load_world_model
from planners.perception import Perception


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """A run with a trained world model."""
    steps: int = 400
    """Batched steps of 256 environments."""
    mixture: float = 0.3
    """Probability of a random action."""
    seed: int = 0
    """Seed of everything random."""


def conditional_entropy(target: np.ndarray, given: list[np.ndarray]) -> float:
    """H(target | given) in bits, from joint counts; every array has one row per step."""
    rows = np.ascontiguousarray(np.concatenate([part.reshape(len(target), -1) for part in given], axis=1))
    numbers: dict[bytes, int] = {}
    known = np.array([numbers.setdefault(row.tobytes(), len(numbers)) for row in rows])
    pairs, counts = np.unique(np.stack([known, target]), axis=1, return_counts=True)
    of_known = np.bincount(known)[pairs[0]]
    return float(-(counts / len(target) * np.log2(counts / of_known)).sum())


def main(options: Arguments) -> None:
    """Play, perceive under every mode, and print the table."""
    domain = load_domain()
    codec = SymbolicCodec(load_world_model(RunFolder(options.run).world_model))
    rng = np.random.default_rng(options.seed)

    def generator() -> np.random.Generator:
        return np.random.default_rng([options.seed, 1])

    network = Perception(codec, "perspective-shift", generator())
    network._shift._shift = PerspectiveShift(codec, "network")
    modes: dict[str, Perception] = {
        "perspective-shift": Perception(codec, "perspective-shift", generator()),
        "perspective-shift, factored": network,
        "perfect-information": Perception(codec, "perfect-information", generator()),
    }
    env: Any = domain.make("following", 256, seed=options.seed)
    observation, _ = env.reset(seed=options.seed)
    seen: list[np.ndarray] = []
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("configuration", "action", "code", *modes)}
    for _ in range(options.steps):
        expert = env.expert_actions("follower")
        for name, perception in modes.items():
            percepts = perception(observation, env.person_views())
            rows[name].append(np.round(percepts.shifted.reshape(256, -1) * 1000).astype(np.int16))
        seen.append(percepts.configurations > 0)
        rows["configuration"].append(percepts.configurations)
        rows["action"].append(np.asarray(expert))
        rows["code"].append(percepts.codes.astype(np.int16))
        action = np.where(rng.random(256) < options.mixture, rng.integers(4, size=256), expert)
        observation, *_ = env.step(action)
    visible = np.concatenate(seen)
    data = {name: np.concatenate(parts)[visible] for name, parts in rows.items()}
    print(f"{visible.sum()} steps with the person in view")
    print(f"{'known':34}{'configuration':>15}{'next action':>13}{'distinct b~':>13}")
    for name in ("b alone", *modes):
        given = [data["code"]] + ([] if name == "b alone" else [data[name]])
        distinct = 0 if name == "b alone" else len({row.tobytes() for row in data[name]})
        figures = [conditional_entropy(data[target], given) for target in ("configuration", "action")]
        label = name if name == "b alone" else f"b, b~ of {name}"
        print(f"{label:34}{figures[0]:15.2f}{figures[1]:13.2f}{distinct:13d}")


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
