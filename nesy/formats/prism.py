"""PRISM models for Storm and PRISM: one module per factor, synchronised on the action.

A factor that looks at others of slice t+1 must move after them. So a step of an action is a chain of
synchronised moves `action`, `action__1`, ...: level by level the next values are drawn into `y_i`, and the last
move, `action__end`, makes them the present ones. Without such arcs a step is one move on the `x_i` themselves.

Reward and termination, where the model has them, become the reward structure "reward" and the flag `done`, after
which nothing moves; rows of those tables that experience never met pay nothing and end nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from nesy.dbn.inference.plans import Reached, reached
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable
from nesy.names import Grammar, remarks
from nesy.run_folder import atomic_path

_WORDS = """A bool clock const ctmc C double dtmc E endinit endinvariant endmodule endobservables endplayer endrewards
endsystem F false filter floor formula func G global I idtmc imdp init invariant int label log ceil ctmdp ma max mdp min
mod module nondeterministic observable observables of P player Pmax Pmin pomdp popta pow prob probabilistic pta R rate
rewards Rmax Rmin round S smg stochastic system tg true U W X"""
_OWN = "doing done ending phase step"
"""Variables and modules of the file, besides x0, y0, factor_x0, ..."""
NAMES = Grammar(
    never=r"_(?![A-Za-z0-9])|\A(?=(?:[xy]|factor_x)[0-9]+\Z).",
    reserved=frozenset(f"{_WORDS} {_OWN}".split()),
    suffix=r"__(?:[0-9]+|end)",
)
"""Names of actions; what follows `__` is the move's place in a chain."""


def write(
    dbn: TwoSliceDBN,
    path: Path,
    start: np.ndarray | None = None,
    plan: Sequence[int] | None = None,
    factors: Sequence[int] | None = None,
    goal: Mapping[int, int] | None = None,
) -> None:
    """Write `dbn` to the file `path` (see `model_text`); by default it starts in the most probable initial values."""
    text = model_text(dbn, dbn.initial.argmax(axis=1) if start is None else start, plan, factors, goal)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def model_text(
    dbn: TwoSliceDBN,
    start: np.ndarray,
    plan: Sequence[int] | None = None,
    factors: Sequence[int] | None = None,
    goal: Mapping[int, int] | None = None,
) -> str:
    """The model as PRISM text.

    Args:
        dbn: the model.
        start: integers [N]: the initial code.
        plan: the actions to take; a chain (`dtmc`) over them with the step counter `step` and the label `end`, of
            which only the rows are written that can be reached. Without it a Markov decision process (`mdp`) in
            which every action is always possible.
        factors: with a plan, the factors asked for at its end: only their cone of influence is written; those of
            the goal by default.
        goal: {factor: value}, becomes the label `goal`.

    Raises:
        UserError: more codes are reachable under the plan than can be followed.
    """
    asked = list(goal) if goal and factors is None else range(dbn.num_factors) if factors is None else list(factors)
    used = None if plan is None else reached(dbn, np.asarray(start), plan, asked)
    levels = [_levels(dbn, a) for a in range(dbn.num_actions)]
    tables = {} if plan is not None else {n: t for n, t in dbn.step_tables.items() if n in ("reward", "termination")}
    layered = any(max(level) > 0 for level in levels) or any(
        ps for table in tables.values() for per_action in table.parents_next for ps in per_action
    )
    actions = [NAMES.encode(name) for name in dbn.action_names]
    lines = ["mdp" if plan is None else "dtmc", ""]
    lines += remarks(named(dbn, NAMES), "//")
    moves = _moves(actions, levels, layered)
    lines += _clock(moves, plan, layered, "termination" in tables)
    for i in range(dbn.num_factors):
        if used is not None and not any(i in factors_of for factors_of in used.slices):
            continue
        top = dbn.num_values - 1
        lines += ["", f"module factor_x{i}", f"  x{i} : [0..{top}] init {int(start[i])};"]
        if layered:
            lines.append(f"  y{i} : [0..{top}] init 0;")
        for a in range(dbn.num_actions) if plan is None else ():
            lines += _commands(dbn, a, i, "", moves[a], levels[a][i], layered, np.arange(dbn.num_rows(a, i)))
        for step, a in enumerate(plan or ()):
            lines += _step(dbn, a, i, step, moves[a], levels[a][i], layered, used)
        lines.append("endmodule")
    lines += _outcomes(dbn, tables, moves, layered)
    if goal:
        lines += ["", f'label "goal" = {" & ".join(f"x{i}={v}" for i, v in goal.items())};']
    return "\n".join(lines) + "\n"


def named(dbn: TwoSliceDBN, grammar: Grammar) -> list[tuple[str, str]]:
    """What a file calls the factors, x0, x1, ..., and the actions, each with its name."""
    factors = [(f"x{i}", name) for i, name in enumerate(dbn.factor_names)]
    return factors + [(grammar.encode(name), name) for name in dbn.action_names]


def _step(
    dbn: TwoSliceDBN,
    action: int,
    factor: int,
    step: int,
    moves: list[str],
    level: int,
    layered: bool,
    used: Reached | None,
) -> list[str]:
    """What one factor does in one step of a plan; it falls to 0 where nobody asks for it."""
    guard = f"step={step} & "
    if used is not None and factor in used.slices[step + 1]:
        return _commands(dbn, action, factor, guard, moves, level, layered, used.rows[step][factor])
    if layered:
        return [f"  [{moves[level]}] step={step} -> true;", f"  [{moves[-1]}] step={step} -> (x{factor}'=0);"]
    return [f"  [{moves[0]}] step={step} -> (x{factor}'=0);"]


def _outcomes(dbn: TwoSliceDBN, tables: dict[str, StepTable], moves: list[list[str]], layered: bool) -> list[str]:
    """Reward structure and termination flag."""
    lines: list[str] = []
    if "termination" in tables:
        lines += ["", "module ending", "  done : bool init false;"]
        for a, names in enumerate(moves):
            chance = _sum_of_rows(tables["termination"], a, -1, layered)
            ends = f"{chance}:(done'=true) + 1-({chance}):(done'=false)" if chance != "0" else "true"
            lines.append(f"  [{names[-1]}] true -> {ends};")
        lines += ["endmodule", "", 'label "done" = done;']
    if "reward" in tables:
        lines += ["", 'rewards "reward"']
        for a, names in enumerate(moves):
            pay = _sum_of_rows(tables["reward"], a, 0, layered)
            lines += [f"  [{names[-1]}] true : {pay};"] if pay != "0" else []
        lines.append("endrewards")
    return lines


def _sum_of_rows(table: StepTable, action: int, column: int, layered: bool) -> str:
    """What a step table says, as a sum over its rows: their conditions exclude each other."""
    parents = table.parents(action, 0)
    values, counts = table.table(action, 0)[:, column], table.counts(action, 0)
    names = [("y" if where and layered else "x") + str(p) for where, p in parents]
    shape = (table.num_values,) * len(parents)
    terms = []
    for row in np.flatnonzero((counts > 0) & (np.abs(values) > 1e-9)).tolist():
        if not parents:
            return repr(float(values[row]))
        when = " & ".join(f"{n}={v}" for n, v in zip(names, np.unravel_index(row, shape), strict=True))
        terms.append(f"({when} ? {float(values[row])!r} : 0)")
    return " + ".join(terms) or "0"


def _levels(dbn: TwoSliceDBN, action: int) -> list[int]:
    """How many factors of slice t+1 must be decided before each, one after the other."""
    level = [0] * dbn.num_factors
    for i in dbn.order:
        level[i] = max((level[p] + 1 for p in dbn.parents_next[action][i]), default=0)
    return level


def _moves(actions: list[str], levels: list[list[int]], layered: bool) -> list[list[str]]:
    """Names of the moves of each action, in order."""
    if not layered:
        return [[action] for action in actions]
    return [
        [action, *(f"{action}__{level}" for level in range(1, max(level_of) + 1)), f"{action}__end"]
        for action, level_of in zip(actions, levels, strict=True)
    ]


def _clock(moves: list[list[str]], plan: Sequence[int] | None, layered: bool, ends: bool) -> list[str]:
    """The module that says which move comes next."""
    lines = ["", "module clock"]
    if plan is not None:
        lines.append(f"  step : [0..{len(plan)}] init 0;")
    if layered:
        most = max(len(names) for names in moves)
        lines.append(f"  phase : [0..{most - 1}] init 0;")
        if plan is None:
            lines.append(f"  doing : [0..{len(moves) - 1}] init 0;")
    for a, names in enumerate(moves):
        steps = [None] if plan is None else [step for step, b in enumerate(plan) if b == a]
        for step in steps:
            for phase, move in enumerate(names):
                guards = [] if step is None else [f"step={step}"]
                guards += ["!done"] if ends and phase == 0 else []
                updates = []
                last = phase == len(names) - 1
                if layered:
                    guards.append(f"phase={phase}")
                    updates.append(f"(phase'={0 if last else phase + 1})")
                    if plan is None:
                        guards += [f"doing={a}"] if phase else []
                        updates += [] if phase else [f"(doing'={a})"]
                if step is not None and last:
                    updates.append(f"(step'={step + 1})")
                guard, update = " & ".join(guards) or "true", " & ".join(updates) or "true"
                lines.append(f"  [{move}] {guard} -> {update};")
    lines.append("endmodule")
    if plan is not None:
        lines += ["", f'label "end" = step={len(plan)};']
    return lines


def _commands(
    dbn: TwoSliceDBN,
    action: int,
    factor: int,
    guard: str,
    moves: list[str],
    level: int,
    layered: bool,
    rows: np.ndarray,
) -> list[str]:
    """The commands of one factor under one action, for some rows of its table."""
    own = "y" if layered else "x"
    parents = dbn.parents(action, factor)
    names = [("y" if where else "x") + str(p) for where, p in parents]
    shape = (dbn.num_values,) * len(parents)
    table = dbn.cpt(action, factor)
    lines = []
    for row in rows.tolist():
        values = np.unravel_index(row, shape) if shape else ()
        when = guard + (" & ".join(f"{n}={v}" for n, v in zip(names, values, strict=True)) or "true")
        then = " + ".join(f"{p!r}:({own}{factor}'={k})" for k, p in enumerate(table[row].tolist()) if p > 0)
        lines.append(f"  [{moves[level]}] {when} -> {then};")
    if layered:
        lines.append(f"  [{moves[-1]}] {guard}true -> (x{factor}'=y{factor}) & (y{factor}'=0);")
    return lines
