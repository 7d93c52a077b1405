"""PDDL of the most probable outcomes, for classical planners.

One action per action, with one conditional effect per factor and context. Arcs within slice t+1 are folded away:
a context is the values of all factors of slice t that the outcome depends on, and only contexts of codes met in
experience are written; on request, only those that most probable outcomes lead to from the start. Where no context
fits, a factor keeps its value.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nesy.dbn.inference import most_probable_next
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats.bayes_nodes import identifier
from nesy.run_folder import atomic_path


def write(
    dbn: TwoSliceDBN,
    path: Path,
    start: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    reachable: bool = False,
    goal: Mapping[int, int] | None = None,
) -> None:
    """Write the domain to `path` and the problem to `NAME_problem.pddl` beside it.

    Args:
        dbn: the model.
        path: the domain's file.
        start: integers [N]: the initial code; by default each factor's most probable initial value.
        goals: integers [G, N]: codes of which one is to be reached; without it the problem has no goal.
        reachable: write only the contexts that can be met from the start if every outcome is the most probable one.
        goal: {factor: value}: the goal as values of some factors, in place of `goals`.

    Raises:
        UserError: the model does not say which codes were met and has too many to write all.
    """
    codes = known_codes(dbn)
    code = dbn.initial.argmax(axis=1) if start is None else np.asarray(start)
    if reachable:
        codes = reachable_codes(dbn, code, codes)
    with atomic_path(path) as temporary:
        temporary.write_text(_domain(dbn, codes, goals), encoding="utf-8")
    with atomic_path(path.with_name(f"{path.stem}_problem{path.suffix}")) as temporary:
        temporary.write_text(_problem(code, goals, goal), encoding="utf-8")


def reachable_codes(dbn: TwoSliceDBN, start: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The known codes that most probable outcomes lead to from a start, integers [M, N]; the start among them."""
    allowed = {tuple(code) for code in known.tolist()}
    found = {tuple(int(v) for v in start)}
    front = list(found)
    while front:
        now = np.array(front)
        later = {
            tuple(code) for a in range(dbn.num_actions) for code in most_probable_next(dbn, now, a, beam=1)[0].tolist()
        }
        front = sorted((later & allowed) - found)
        found |= set(front)
    return np.array(sorted(found))


def known_codes(dbn: TwoSliceDBN) -> np.ndarray:
    """The codes met in experience, or all codes of a small model: integers [C, N].

    Raises:
        UserError: there are too many.
    """
    if "codes" in dbn.tables:
        return dbn.tables["codes"]
    if dbn.num_values**dbn.num_factors > 4096:
        raise UserError("this model does not say which codes were met in experience, and has too many to list")
    return np.array(list(np.ndindex(*(dbn.num_values,) * dbn.num_factors)))


def action_name(dbn: TwoSliceDBN, action: int) -> str:
    """The name of an action in the file."""
    return identifier(dbn.action_names[action]).lower()


def _atom(factor: int, value: int) -> str:
    return f"(x{factor}-{value})"


def _domain(dbn: TwoSliceDBN, codes: np.ndarray, goals: np.ndarray | None) -> str:
    lines = ["(define (domain dbn)", "  (:requirements :strips :conditional-effects :negative-preconditions)"]
    lines.append("  (:predicates (reached)")
    for i in range(dbn.num_factors):
        lines.append("    " + " ".join(_atom(i, k) for k in range(dbn.num_values)))
    lines.append("  )")
    for a in range(dbn.num_actions):
        lines += [f"  (:action {action_name(dbn, a)}", "    :parameters ()"]
        lines += ["    :precondition ()", "    :effect (and"]
        # factor by factor, so that a factor's outcome depends on its own context alone
        later, _ = most_probable_next(dbn, codes, a, beam=1)
        for i in range(dbn.num_factors):
            scope = _scope(dbn, a, i)
            contexts, first = np.unique(codes[:, scope], axis=0, return_index=True)
            for context, row in zip(contexts.tolist(), first.tolist(), strict=True):
                value = int(later[row, i])
                old = dict(zip(scope, context, strict=True)).get(i)
                if old == value:
                    continue
                when = " ".join(_atom(p, v) for p, v in zip(scope, context, strict=True))
                losers = [old] if old is not None else [k for k in range(dbn.num_values) if k != value]
                effects = " ".join(f"(not {_atom(i, k)})" for k in losers)
                lines.append(f"      (when (and {when}) (and {effects} {_atom(i, value)}))")
        lines.append("    ))")
    for number, goal in enumerate([] if goals is None else np.asarray(goals).tolist()):
        there = " ".join(_atom(i, v) for i, v in enumerate(goal))
        lines += [f"  (:action arrive-{number}", "    :parameters ()", f"    :precondition (and {there})"]
        lines.append("    :effect (reached))")
    return "\n".join([*lines, ")"]) + "\n"


def _scope(dbn: TwoSliceDBN, action: int, factor: int) -> list[int]:
    """The factors of slice t that the most probable value of a factor depends on."""
    scope = set(dbn.parents_now[action][factor])
    for p in dbn.parents_next[action][factor]:
        scope |= set(_scope(dbn, action, p))
    return sorted(scope)


def _problem(code: np.ndarray, goals: np.ndarray | None, goal: Mapping[int, int] | None) -> str:
    start = " ".join(_atom(i, int(v)) for i, v in enumerate(code))
    wanted = "(reached)" if goals is not None and len(goals) else "(and)"
    if goal:
        wanted = "(and " + " ".join(_atom(i, v) for i, v in goal.items()) + ")"
    return f"(define (problem start) (:domain dbn)\n  (:init {start})\n  (:goal {wanted}))\n"
