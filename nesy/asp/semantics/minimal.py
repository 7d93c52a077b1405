"""The shortest rules that say exactly where something holds, found by answer set programming (minimal.lp).

For cases without noise and with few conditions: what a value of a readable factor means in predicates. One
conjunction is looked for first, then two, then three; where that takes too much searching, nothing is returned (the
limit is a number of conflicts, not of seconds: the same views give the same rules on every machine).
"""

from __future__ import annotations

import clingo
import numpy as np

from nesy.asp.program.encoding import ENCODINGS
from nesy.dbn.rows import unique_rows

MOST_LITERALS = 250
MOST_PATTERNS = 400
MOST_CONFLICTS = 3000

Conjunction = tuple[tuple[int, bool], ...]
"""(column, whether it holds) pairs, ascending."""


def minimal_form(columns: np.ndarray, truth: np.ndarray, most_rules: int = 3) -> tuple[Conjunction, ...] | None:
    """The fewest conditions, in at most `most_rules` conjunctions, that hold exactly where `truth` does.

    Of forms of one length the one with the earliest columns is taken.

    Args:
        columns: bool [n, C].
        truth: bool [n], true somewhere and false somewhere.
        most_rules: most conjunctions.

    Returns:
        The conjunctions; None where there is no such form, or none was proven shortest within 3,000 conflicts.
    """
    positive, negative = _patterns(columns[truth]), _patterns(columns[~truth])
    for rules in range(1, most_rules + 1):
        found = _solve(positive, negative, rules)
        if found is not None:
            return found
    return None


def _patterns(rows: np.ndarray) -> np.ndarray:
    return np.asarray(rows[unique_rows(rows.astype(np.uint8))[0]])


def _solve(positive: np.ndarray, negative: np.ndarray, rules: int) -> tuple[Conjunction, ...] | None:
    # literal 2c: column c holds; 2c+1: it does not
    holds = np.stack([positive, ~positive], axis=2).reshape(len(positive), -1)
    others = np.stack([negative, ~negative], axis=2).reshape(len(negative), -1)
    useful = ~others.all(axis=0) & (holds.all(axis=0) if rules == 1 else holds.any(axis=0))
    # of literals that hold in the same cases the first will do
    cases = np.concatenate([holds, others]).T[np.flatnonzero(useful)]
    first, _, _ = unique_rows(cases.astype(np.uint8))
    literals = np.flatnonzero(useful)[np.sort(first)].tolist()
    if not literals or others[:, literals].all(axis=1).any():
        return None
    # cases that the literals left cannot tell apart are one
    excludes = _patterns(~others[:, literals])
    misses = _patterns(~holds[:, literals])
    if rules > 1 and (len(literals) > MOST_LITERALS or len(excludes) + len(misses) > MOST_PATTERNS):
        return None
    lines = [f"rules({rules}). positive(1..{len(misses)}). negative(1..{len(excludes)})."]
    lines += [f"literal({x},{x // 2 + x % 2})." for x in literals]
    lines += [f"excludes({literals[x]},{n + 1})." for n, x in zip(*np.nonzero(excludes), strict=True)]
    lines += [f"misses({literals[x]},{p + 1})." for p, x in zip(*np.nonzero(misses), strict=True)]
    control = clingo.Control(
        ["--warn=none", "--opt-mode=opt", "--opt-strategy=usc", "--models=0", f"--solve-limit={MOST_CONFLICTS}"]
    )
    control.load(str(ENCODINGS / "minimal.lp"))
    control.add("base", [], "\n".join(lines))
    control.ground([("base", [])])
    best: list[tuple[int, int]] | None = None
    with control.solve(yield_=True) as handle:
        for model in handle:
            best = [(a.arguments[0].number, a.arguments[1].number) for a in model.symbols(shown=True)]
        if not handle.get().exhausted:
            return None
    if best is None:
        return None
    conjunctions = {tuple(sorted((x // 2, x % 2 == 0) for r, x in best if r == rule)) for rule in range(1, rules + 1)}
    return tuple(sorted(conjunctions))
