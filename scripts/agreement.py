"""Three programs on one number: P(goal | plan) of a run's extracted model, by us, by pyAgrum and by Storm.

Plans are random, from random codes met in experience; the goal is the likeliest value of a random factor at the end.
The whole model gives every next code some probability, so plans of several steps reach millions of codes; compared is
its known part (nesy.dbn.parts.known_part), and `elsewhere` says how far the whole model's P(goal) may be above. One
step is compared on the whole model too.

    python scripts/agreement.py --run runs/demo
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from nesy.dbn import TwoSliceDBN
from nesy.dbn.inference.plans import reached
from nesy.dbn.parts import known_part
from nesy.formats.programs.agreement import by_pyagrum, by_storm, own


def main() -> None:
    """Print one line per plan, and the largest differences."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/default"))
    parser.add_argument("--plans", type=int, default=10)
    parser.add_argument("--steps", type=int, default=4, help="longest plan")
    parser.add_argument("--least", type=float, default=0.01, help="least probability of an entry of the known part")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    whole = TwoSliceDBN.load(options.run / "dbn")
    part = known_part(whole, options.least)
    rng = np.random.default_rng(options.seed)
    codes = whole.tables["codes"]
    worst = 0.0
    print("model   steps  codes  rows   own             to pyAgrum  to Storm   elsewhere  seconds")
    for number in range(options.plans):
        start = codes[rng.integers(len(codes))].astype(int)
        plan = rng.integers(whole.num_actions, size=1 + number % options.steps).tolist()
        factor = int(rng.integers(whole.num_factors))
        for name, model in (("known", part), ("whole", whole)):
            if name == "whole" and len(plan) > 1:
                continue
            began = time.perf_counter()
            used = reached(model, start, plan, (factor,))
            chances = np.bincount(used.codes[:, factor], used.weights, model.num_values)
            goal = {factor: int(chances[: whole.num_values].argmax())}
            mine = own(model, start, plan, goal)
            apart = [abs(by(model, start, plan, goal) - mine) for by in (by_pyagrum, by_storm)]
            worst = max(worst, *apart)
            rows = sum(len(r) for step in used.rows for r in step.values())
            elsewhere = chances[whole.num_values :].sum()
            print(
                f"{name:7} {len(plan):5} {len(used.codes):6} {rows:5}   {mine:.12f}  {apart[0]:.1e}     {apart[1]:.1e}"
                f"    {elsewhere:.4f}     {time.perf_counter() - began:.2f}"
            )
    print(f"largest difference: {worst:.2e}")


if __name__ == "__main__":
    main()
