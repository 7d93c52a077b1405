"""Are true parents found? Random models of 8 factors x 8 values with 2 parents, from 20,000 transitions each.

python scripts/recovery.py --models 20
"""

from __future__ import annotations

import argparse

from nesy.dbn.evaluation.recovery import recover
from nesy.dbn.learning.structure import SCORES, Search


def main() -> None:
    """Print precision and recall of every score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=int, default=20)
    parser.add_argument("--transitions", type=int, default=20_000)
    parser.add_argument("--scores", nargs="+", choices=SCORES, default=list(SCORES))
    options = parser.parse_args()
    for score in options.scores:
        found = recover(range(options.models), options.transitions, Search(score=score, max_next=1))
        print(f"{score:5} precision {found.precision:.4f}  recall {found.recall:.4f}  ({found.true} true arcs)")


if __name__ == "__main__":
    main()
