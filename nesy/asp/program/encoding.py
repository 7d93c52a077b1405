"""Our own encodings, run in this process: they are known to end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import clingo

ENCODINGS = Path(__file__).parents[1] / "encodings"


def run_encoding(names: Sequence[str], facts: str, optimise: bool = False) -> list[clingo.Symbol]:
    """The shown atoms of our own encodings on some facts; they are known to end, so no limits are needed.

    Args:
        names: the encodings.
        facts: program text.
        optimise: whether to look for the best model; otherwise the first will do.
    """
    options = ["--opt-mode=opt", "--models=0"] if optimise else ["--opt-mode=ignore", "--models=1"]
    control = clingo.Control(["--warn=none", *options])
    for name in names:
        control.load(str(ENCODINGS / f"{name}.lp"))
    control.add("base", [], facts)
    control.ground([("base", [])])
    atoms: list[clingo.Symbol] = []
    with control.solve(yield_=True) as handle:
        for model in handle:
            atoms = list(model.symbols(shown=True))
    return sorted(atoms)
