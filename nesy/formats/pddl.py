"""PDDL of the most probable outcomes, for classical planners: plain STRIPS.

One action per action and code met in experience (`forward-17`): its preconditions are the values of that code, its
effects the values that change in the most probable next code. A step is left out whose most probable outcome is a code
that experience never met; on request, so are all codes that the outcomes do not lead to from the start.

Most probable outcomes alone may never lead anywhere (a corridor that mostly goes on never shows its end). With
`outcomes` above 1 every step has that many variants (`forward-17-1`), each with the cost 1 + 100 * -ln(probability):
the planner then chooses what happens, and pays for its optimism; who executes the plan plans again when surprised.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from nesy.dbn.inference.exact import likely_next
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats.prism import named
from nesy.names import Grammar, remarks
from nesy.run_folder import atomic_path

NAMES = Grammar(
    first="[a-z]",
    others="[a-z0-9_]",
    never=r"\A(?=x[0-9]+\Z).",
    reserved=frozenset({"arrive"}),
    suffix=r"(?:-[0-9]+){1,2}",
)
"""Names of actions, in a format that knows no case; numbers follow for the code and the outcome."""

LEAST = 0.05
"""Least probability of an outcome that is not the most probable one."""


def write(
    dbn: TwoSliceDBN,
    path: Path,
    start: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    reachable: bool = False,
    goal: Mapping[int, int] | None = None,
    outcomes: int = 1,
) -> None:
    """Write the domain to `path` and the problem to `NAME_problem.pddl` beside it.

    Args:
        dbn: the model.
        path: the domain's file.
        start: integers [N]: the initial code; by default each factor's most probable initial value.
        goals: integers [G, N]: codes of which one is to be reached; without it the problem has no goal.
        reachable: write only the codes that the outcomes lead to from the start; with `goals`, in as many steps as
            the nearest of them takes, and one more.
        goal: {factor: value}: the goal as values of some factors, in place of `goals`.
        outcomes: how many outcomes of a step are written, the most probable first; further ones only from a
            probability of `LEAST` on.

    Raises:
        UserError: the model does not say which codes were met and has too many to write all.
    """
    codes = known_codes(dbn)
    code = dbn.initial.argmax(axis=1) if start is None else np.asarray(start)
    if reachable:
        codes = reachable_codes(dbn, code, codes, outcomes, goals)
    with atomic_path(path) as temporary:
        temporary.write_text(_domain(dbn, codes, goals, outcomes), encoding="utf-8")
    with atomic_path(path.with_name(f"{path.stem}_problem{path.suffix}")) as temporary:
        temporary.write_text(_problem(code, goals, goal, outcomes), encoding="utf-8")


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


def reachable_codes(
    dbn: TwoSliceDBN, start: np.ndarray, known: np.ndarray, outcomes: int = 1, goals: np.ndarray | None = None
) -> np.ndarray:
    """The known codes that the outcomes lead to from a start, integers [M, N], in order; the start among them.

    With goals, integers [G, N], only those met in as many steps as the nearest goal takes, and one more.
    """
    allowed = {tuple(code) for code in known.tolist()}
    wanted = set() if goals is None else {tuple(code) for code in np.asarray(goals).tolist()}
    found = {tuple(int(v) for v in start)}
    front, left = list(found), -1
    while front and left != 0:
        now = np.array(front)
        later = {code for a in range(dbn.num_actions) for _, code, _ in _outcomes(dbn, now, a, outcomes)}
        front = sorted((later & allowed) - found)
        left = left - 1 if left > 0 else 1 if found & wanted or set(front) & wanted else -1
        found |= set(front)
    return np.array(sorted(found))


def _outcomes(
    dbn: TwoSliceDBN, codes: np.ndarray, action: int, most: int
) -> Iterator[tuple[int, tuple[int, ...], float]]:
    """(number of the code, next code, probability) of the outcomes written."""
    later, chances = likely_next(dbn, codes, action)
    for number in range(len(codes)):
        for rank in range(min(most, later.shape[1])):
            if rank == 0 or chances[number, rank] >= LEAST:
                yield number, tuple(later[number, rank].tolist()), float(chances[number, rank])


def action_of(dbn: TwoSliceDBN, name: str) -> int | None:
    """The action that a step of a plan means; None for the step that ends it."""
    names = [NAMES.encode(action) for action in dbn.action_names]
    head = name.strip("() \n").lower().split("-")[0]
    return names.index(head) if head in names else None


def _atom(factor: int, value: int) -> str:
    return f"(x{factor}-{value})"


def _domain(dbn: TwoSliceDBN, codes: np.ndarray, goals: np.ndarray | None, most: int) -> str:
    costs = most > 1
    lines = [
        *remarks(named(dbn, NAMES), ";"),
        "(define (domain dbn)",
        f"  (:requirements :strips{' :action-costs' if costs else ''})",
    ]
    lines.append("  (:predicates (reached)")
    for i in range(dbn.num_factors):
        lines.append("    " + " ".join(_atom(i, k) for k in range(dbn.num_values)))
    lines.append("  )")
    lines += ["  (:functions (total-cost) - number)"] if costs else []
    known = {tuple(code) for code in codes.tolist()}
    plain = codes.tolist()
    for a, action in enumerate(dbn.action_names):
        before, rank = -1, 0
        for number, later, chance in _outcomes(dbn, codes, a, most):
            rank, before = (rank + 1 if number == before else 0), number
            now = plain[number]
            changes = [i for i in range(dbn.num_factors) if now[i] != later[i]]
            if not changes or later not in known:
                continue
            name = f"{NAMES.encode(action)}-{number}" + (f"-{rank}" if rank else "")
            lines.append(f"  (:action {name} :parameters ()")
            lines.append(f"    :precondition (and {' '.join(_atom(i, v) for i, v in enumerate(now))})")
            effects = " ".join(f"(not {_atom(i, now[i])}) {_atom(i, later[i])}" for i in changes)
            effects += f" (increase (total-cost) {1 + round(-100 * float(np.log(chance)))})" if costs else ""
            lines.append(f"    :effect (and {effects}))")
    for number, goal in enumerate([] if goals is None else np.asarray(goals).tolist()):
        there = " ".join(_atom(i, v) for i, v in enumerate(goal))
        lines.append(f"  (:action arrive-{number} :parameters () :precondition (and {there}) :effect (reached))")
    return "\n".join([*lines, ")"]) + "\n"


def _problem(code: np.ndarray, goals: np.ndarray | None, goal: Mapping[int, int] | None, most: int) -> str:
    start = " ".join(_atom(i, int(v)) for i, v in enumerate(code))
    wanted = "(reached)" if goals is not None and len(goals) else "(and)"
    if goal:
        wanted = "(and " + " ".join(_atom(i, v) for i, v in goal.items()) + ")"
    costs = ("(= (total-cost) 0) ", "\n  (:metric minimize (total-cost))") if most > 1 else ("", "")
    return f"(define (problem start) (:domain dbn)\n  (:init {costs[0]}{start})\n  (:goal {wanted}){costs[1]})\n"
