"""What an agent knows and holds possible, by cautious and brave reasoning over the codes of its particles.

K p: p holds in every particle; M p: in at least one. The particles may be the robot's own, or those of the
perspective-shifted belief: then the answers are about what the person knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import clingo
import numpy as np

from nesy.asp.program.encoding import ENCODINGS
from nesy.asp.program.names import encode
from nesy.asp.questions.planning import PredicateTruth
from nesy.dbn.rows import unique_rows
from nesy.errors import UserError


@dataclass(frozen=True)
class Knowledge:
    """What is known about one predicate."""

    predicate: str
    knows: bool
    """K p: it holds in every possible world."""
    knows_not: bool
    """K not p: it fails in every possible world."""
    possible: bool
    """M p: it may hold."""
    possible_not: bool
    """M not p: it may fail."""


class BeliefQuestions:
    """Questions about sets of particles, for one codebook."""

    def __init__(self, truth: PredicateTruth) -> None:
        self.truth = truth

    def ask(self, particles: np.ndarray, predicates: Sequence[str]) -> dict[str, Knowledge]:
        """What the holder of some particles knows about some predicates.

        A particle whose code leaves a predicate open (no view met has it, or its views disagree) is a world in which
        the predicate may hold and may fail.

        Args:
            particles: uint8 [n, N], codes held possible.
            predicates: names.

        Raises:
            UserError: no particles, or no such predicate.
        """
        particles = np.asarray(particles)
        if particles.ndim != 2 or not len(particles):
            raise UserError("a question about a belief needs at least one particle")
        book = self.truth.codebook
        for name in predicates:
            book.predicate(name)
        # worlds that agree on what is asked about are one
        holds, fails = self.truth.of(particles)
        columns = [book.predicate_names.index(name) for name in predicates]
        first, _, _ = unique_rows(np.concatenate([holds[:, columns], fails[:, columns]], axis=1).astype(np.uint8))
        holds, fails = holds[first], fails[first]
        lines = [f"world(0..{len(first) - 1})."]
        for name in predicates:
            column, constant = book.predicate_names.index(name), encode(name)
            lines.append(f"asked({constant}).")
            lines += [f"holds({c},{constant})." for c in np.flatnonzero(holds[:, column]).tolist()]
            lines += [f"fails({c},{constant})." for c in np.flatnonzero(fails[:, column]).tolist()]
        control = clingo.Control(["--warn=none"])
        control.load(str(ENCODINGS / "knows.lp"))
        control.add("base", [], "\n".join(lines))
        control.ground([("base", [])])
        known, possible = _consequences(control, "cautious"), _consequences(control, "brave")
        result = {}
        for name in predicates:
            yes, no = f"true({encode(name)})", f"false({encode(name)})"
            result[name] = Knowledge(name, yes in known, no in known, yes in possible, no in possible)
        return result


def _consequences(control: clingo.Control, mode: str) -> set[str]:
    """The atoms in all models (cautious) or in some (brave): the solver's last model."""
    settings: Any = control.configuration.solve
    settings.enum_mode, settings.models = mode, 0
    atoms: set[str] = set()
    with control.solve(yield_=True) as handle:
        for model in handle:
            atoms = {str(symbol) for symbol in model.symbols(shown=True)}
    return atoms
