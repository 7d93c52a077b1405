"""Does the code carry over to maps never seen? Trains on some maps of a variant, tests on others.

python scripts/generalisation.py --variant occluded --folder runs/generalisation
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro

from domains.core import load_domain, symmetries_of
from nesy.config import CollectConfig, TrainConfig
from nesy.log.collection import collect
from nesy.log.experience import Experience
from nesy.progress import ConsoleProgress
from nesy.world_model import SymbolicCodec, load_world_model, train
from nesy.world_model.distinct import transitions_of, view_keys
from nesy.world_model.training.gates import limits, next_gates, view_gates


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    folder: Path = Path("runs/generalisation")
    """Where experience and model go."""
    variant: str = "occluded"
    """Variant of person following."""
    test_share: float = 0.2
    """Share of the maps that is only tested on."""
    most_maps: int = 5000
    """Most maps to learn from; what was met on further ones is left out."""
    seed: int = 0
    """Seed of everything random."""
    collect: CollectConfig = field(
        default_factory=lambda: CollectConfig(crossing_episodes=5000, following_episodes=3200)
    )
    """Experience."""
    train: TrainConfig = field(default_factory=lambda: TrainConfig(held_out=0.0, searches=1, time_limit=0.0))
    """Training."""


def main(arguments: Arguments) -> None:
    """Collect, train on some maps, print the figures on the others as JSON."""
    progress, seed = ConsoleProgress(), arguments.seed
    folder = arguments.folder / "experience"
    collect(load_domain(), arguments.collect, folder, seed, progress, variant=arguments.variant)
    experience = Experience.load(folder)
    apart = experience.held_out_maps(arguments.test_share, np.random.default_rng(seed))
    maps = np.random.default_rng(seed).permutation(np.unique(experience.map_id[~apart]))[: arguments.most_maps]
    learned, tested = experience.select(np.isin(experience.map_id, maps)), experience.select(apart)
    domain = load_domain()
    # without the domain, or all views of the variant would be learned
    config = replace(arguments.train, held_out=0.0, weighting=arguments.train.weighting or domain.spec.weighting)
    train(learned, config, arguments.folder / "world_model", seed, progress, symmetries=symmetries_of(domain))
    codec = SymbolicCodec(load_world_model(arguments.folder / "world_model"))
    test = transitions_of(tested, weighting=domain.spec.weighting)
    known = view_keys(transitions_of(learned).views)
    new = ~np.isin(view_keys(test.views), known)
    rebuilt = (codec.views(codec.codes(test.views)) == test.views).reshape(test.num_views, -1)
    figures = {
        "maps_learned": len(np.unique(learned.map_id)),
        "maps_tested": len(np.unique(tested.map_id)),
        **view_gates(codec, test.views),
        **next_gates(codec, test),
        "limits": limits(test),
        "new_views": int(new.sum()),
        "new_views_exact": float(rebuilt[new].all(1).mean()) if new.any() else 1.0,
        "views_exact_by_visits": float(np.average(rebuilt.all(1), weights=test.visits)),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
