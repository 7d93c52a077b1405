"""A classical planner drives: Fast Downward on the PDDL of a run's model, in the crossing task, planning on surprise.

python scripts/pddl_plans.py --run runs/demo
"""

from __future__ import annotations

import argparse
from pathlib import Path

from domains.core import load_domain
from nesy.dbn import Codebook, TwoSliceDBN
from nesy.formats.programs.execution import execute
from nesy.world_model import SymbolicCodec, load_world_model


def main() -> None:
    """Print what came of the episodes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/default"))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--in-sight", action="store_true", help="an expert drives until the goal is in view")
    options = parser.parse_args()
    codec = SymbolicCodec(load_world_model(options.run / "world_model"))
    dbn, codebook = TwoSliceDBN.load(options.run / "dbn"), Codebook.load(options.run / "dbn")
    how = {"outcomes": 1, "in_sight": True} if options.in_sight else {}
    done = execute(load_domain(), "paper", dbn, codebook, codec.codes, options.episodes, options.seed, **how)
    print(f"goal entered in {done.reached} of {done.episodes} episodes, {done.steps / done.episodes:.1f} steps each")
    print(f"{done.calls} problems for the planner, {done.unsolved} without a plan, {done.wandering} random steps")
    print(f"{done.surprises} steps ended in another view than planned")


if __name__ == "__main__":
    main()
