"""What a rule about the person is worth: "a person facing a wall does not walk forward", as a prior on the influence.

The planners' model is learned from few and from many episodes of following, and as many of the crossing task's
expert, without and with the rule (influence_rules). Measured: how probable it calls the moves that persons
really made, in bits per move, on episodes it was not learned from; how probable moves into walls were before; and the
return of our own search. Pairs of figures are compared move by move and episode by episode (same maps, same seeds);
intervals are bootstrapped over episodes.

    python scripts/influence_rules.py --run runs/demo
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from domains.core import Domain, load_domain
from nesy.cli import configuration
from nesy.dbn import TwoSliceDBN
from nesy.log.collection import collect_following
from nesy.log.experience import Experience
from nesy.run_folder import RunFolder
from nesy.world_model import SymbolicCodec, load_world_model
from planners.comparison.evaluation import Player, evaluate
from planners.comparison.statistics import bootstrap
from planners.config import SearchConfig
from planners.perception import Perception
from planners.person_following.agent import PlanningAgent
from planners.person_following.ialm import IALM
from planners.person_following.ialm_learning import learn_ialm
from planners.person_following.influence_rules import constrain_influence
from planners.person_following.motion import WAIT

RULE = "person_forbidden(forward) :- person_now(wall_ahead)."


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/default")
    """A run with experience, world model and 2DBN."""
    rules: Path | None = None
    """A rule file in place of the rule above."""
    learned_from: tuple[int, ...] = (3, 10, 30, 100, 1000)
    """Episodes of following, and of the crossing task's expert, that the model is learned from."""
    tested_on: int = 500
    """Episodes of following, of another seed, on which moves are predicted."""
    episodes: int = 336
    """Episodes that the search plays with each model; 0: none."""
    simulations: int = 60
    """Simulations per decision."""
    seed: int = 0
    """Seed of everything random."""


def main() -> None:
    """Print one line per number of episodes."""
    options = tyro.cli(Arguments, description=__doc__)
    run = RunFolder.open(options.run)
    domain = load_domain(configuration.load(run.config).domain)
    codec = SymbolicCodec(load_world_model(run.world_model))
    dbn, experience = TwoSliceDBN.load(run.dbn), Experience.load(run.experience)
    followed = np.char.startswith(experience.source, "following")
    expert = experience.source == "crossing-expert"
    rules: list[str | Path] = [RULE if options.rules is None else options.rules]
    with tempfile.TemporaryDirectory() as folder:
        collect_following(domain, options.tested_on, 0.5, folder, options.seed + 77)
        test = Experience.load(Path(folder))
    moving = np.flatnonzero((test.person_action >= 0) & (test.person_action < WAIT))
    codes, moves = codec.codes(test.person_view[moving]), test.person_action[moving].astype(np.int64)
    _, episode = np.unique(test.episode[moving], return_inverse=True)
    for number in options.learned_from:
        chosen = np.zeros(len(experience), bool)
        for kind in (followed, expert):
            chosen |= kind & np.isin(experience.episode, np.unique(experience.episode[kind])[:number])
        model = learn_ialm(dbn, codec, experience.select(chosen))
        constrained, change = constrain_influence(model, rules, codec, domain)
        bits = [-np.log2(m.influence_of(codes)[np.arange(len(moves)), moves]) for m in (model, constrained)]
        row: dict[str, Any] = {
            "episodes": number,
            "bits": round(float(bits[0].mean()), 4),
            "bits_with_rule": round(float(bits[1].mean()), 4),
            "bits_saved": _interval(np.bincount(episode, bits[0] - bits[1]) / np.bincount(episode), options.seed),
            "change": None if change is None else change.to_dict(),
        }
        if options.episodes:
            returns = [_returns(m, codec, domain, options) for m in (model, constrained)]
            row["return"] = _interval(returns[0], options.seed)
            row["return_gained"] = _interval(returns[1] - returns[0], options.seed)
        print(json.dumps(row), flush=True)


def _returns(model: IALM, codec: SymbolicCodec, domain: Domain, options: Arguments) -> np.ndarray:
    """Returns of the search in a model, episode by episode."""
    parts = []
    for part in range(-(-options.episodes // 168)):
        seed = options.seed + part
        perception = Perception(codec, "perspective-shift", np.random.default_rng([seed, 1]))
        search = SearchConfig(simulations=options.simulations)
        agent = PlanningAgent("search", model, search, domain.spec.geometry, seed)
        parts.append(evaluate(domain, "paper", Player(agent, perception), 168, seed)["return"])
    return np.concatenate(parts)


def _interval(values: np.ndarray, seed: int) -> dict[str, float | None]:
    found = bootstrap(values, seed).as_dict()
    return {name: None if value is None else round(value, 4) for name, value in found.items()}


if __name__ == "__main__":
    main()
