"""Play the compiled rules against the plain reference of the tests, step by step, for as long as wished.

    python scripts/check_exactness.py [--steps 100000] [--variants paper clean ...]

Run from the root of the project. Any difference in observation, configuration, reward, outcome or state stops it.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections import Counter
from pathlib import Path

import gymnasium

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from domains.person_following.variants import VARIANTS, parameters_of
from tests.domains.play import PLAYERS, compare_play
from tests.domains.reference import Reference


def main() -> None:
    """Play and print how often each outcome and each rare event came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000, help="steps per variant, all players together")
    parser.add_argument("--variants", nargs="+", choices=sorted(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for variant in arguments.variants:
        started = time.monotonic()
        rules = dataclasses.asdict(parameters_of(variant))
        counts: Counter[str] = Counter()
        for player in PLAYERS:
            env = gymnasium.make("nesy/PersonFollowing-v0", variant=variant)
            steps = arguments.steps // len(PLAYERS)
            counts += compare_play(env, Reference(None, **rules), player, steps, arguments.seed)
        seconds = time.monotonic() - started
        print(f"{variant}: {arguments.steps} steps, no difference, {seconds:.0f} s; {dict(counts)}", flush=True)


if __name__ == "__main__":
    main()
