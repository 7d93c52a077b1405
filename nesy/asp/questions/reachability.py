"""What can be reached from a code, in how many steps at least, and by which way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nesy.asp.program.conditions import parse_literals
from nesy.asp.program.encoding import run_encoding
from nesy.asp.questions.planning import HOPE, PredicateTruth, reachable, satisfied
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN


@dataclass(frozen=True)
class Reach:
    """How soon something can hold."""

    goal: str
    steps: int | None
    """Fewest steps; None if it cannot be reached within the limit."""
    actions: tuple[str, ...]
    """A way there, if every outcome is the hoped-for one."""
    code: tuple[int, ...]
    """Where it holds then."""


@dataclass(frozen=True)
class Reachability:
    """What can be reached."""

    found: tuple[Reach, ...]
    codes: int
    """Codes that can be reached."""
    exhausted: bool
    """Whether there is nothing more to reach in any number of steps."""
    least: float = HOPE
    """Outcomes less probable than this are not hoped for, but for the most probable one of each action."""


def reach(
    dbn: TwoSliceDBN,
    codebook: Codebook | None,
    truth: PredicateTruth | None,
    start: np.ndarray,
    goals: Sequence[str],
    max_steps: int,
) -> Reachability:
    """How soon each goal can hold if outcomes are as hoped for.

    Args:
        dbn: the model.
        codebook: what predicates mean.
        truth: what holds in the codebook's codes; codes that were not met are dead ends then.
        start: integers [N].
        goals: conditions as in nesy.asp.program.conditions, each a goal of its own.
        max_steps: most steps.

    Raises:
        UserError: a wrong condition, or too many codes can be reached.
    """
    codes, moves, distance = reachable(dbn, start, max_steps, truth, optimistic=True)
    facts = [f"first({c},{t})." for c, t in enumerate(distance.tolist())]
    for number, goal in enumerate(goals):
        good = satisfied(parse_literals(dbn, codebook, goal), codes, truth)
        facts += [f"goal({c},{number})." for c in np.flatnonzero(good).tolist()]
    before: dict[int, tuple[int, int]] = {}
    for move in moves:
        if distance[move.target] == distance[move.source] + 1:
            before.setdefault(move.target, (move.source, move.action))
    found = {}
    for atom in run_encoding(("reach",), "\n".join(facts)):
        goal_number, code, steps = (argument.number for argument in atom.arguments)
        way, here = [], code
        while here:
            here, action = before[here]
            way.append(dbn.action_names[action])
        found[goal_number] = (steps, tuple(reversed(way)), tuple(int(v) for v in codes[code]))
    records = [
        Reach(goal, *found[number]) if number in found else Reach(goal, None, (), ())
        for number, goal in enumerate(goals)
    ]
    return Reachability(tuple(records), len(codes), bool(distance.max() < max_steps))
