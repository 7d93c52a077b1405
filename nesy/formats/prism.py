"""PRISM models for Storm and PRISM: one module per factor, synchronised on the action.

A factor that looks at others of slice t+1 must move after them. So a step of an action is a chain of
synchronised moves `action`, `action_1`, ...: level by level the next values are drawn into `y_i`, and the last
move, `action_end`, makes them the present ones. Without such arcs a step is one move on the `x_i` themselves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.plans import cone, reachable_values
from nesy.formats.bayes_nodes import identifier
from nesy.run_folder import atomic_path


def write(
    dbn: TwoSliceDBN,
    path: Path,
    start: np.ndarray | None = None,
    plan: Sequence[int] | None = None,
    factors: Sequence[int] | None = None,
) -> None:
    """Write `dbn` to the file `path` (see `model_text`); by default it starts in the most probable initial values."""
    text = model_text(dbn, dbn.initial.argmax(axis=1) if start is None else start, plan, factors)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def model_text(
    dbn: TwoSliceDBN, start: np.ndarray, plan: Sequence[int] | None = None, factors: Sequence[int] | None = None
) -> str:
    """The model as PRISM text.

    Args:
        dbn: the model.
        start: integers [N]: the initial code.
        plan: the actions to take; a chain (`dtmc`) over them with the step counter `step` and the label `end`.
            Without it a Markov decision process (`mdp`) in which every action is always possible.
        factors: with a plan, the factors asked for at its end: only their cone of influence is written.
    """
    values = None if plan is None else reachable_values(dbn, start, plan)
    levels = [_levels(dbn, a) for a in range(dbn.num_actions)]
    layered = any(max(level) > 0 for level in levels)
    names = [f"x{i}" for i in range(dbn.num_factors)]
    actions = [identifier(name) for name in dbn.action_names]
    needed = None if plan is None else cone(dbn, plan, range(dbn.num_factors) if factors is None else factors)
    lines = ["mdp" if plan is None else "dtmc", ""]
    lines += [f"// x{i}: {name}" for i, name in enumerate(dbn.factor_names)]
    moves = _moves(actions, levels, layered)
    lines += _clock(moves, plan, layered)
    for i, name in enumerate(names):
        used = None if needed is None else [step for step in range(1, len(needed)) if i in needed[step]]
        if needed is not None and not used and i not in needed[0]:
            continue
        top = dbn.num_values - 1
        lines += ["", f"module factor_{name}", f"  {name} : [0..{top}] init {int(start[i])};"]
        if layered:
            lines.append(f"  y{i} : [0..{top}] init 0;")
        if plan is None:
            for a in range(dbn.num_actions):
                lines += _commands(dbn, a, i, "", moves[a], levels[a][i], layered, None)
        else:
            for step, a in enumerate(plan):
                guard = f"step={step} & "
                if used is not None and step + 1 in used:
                    assert values is not None
                    possible = (values[step], values[step + 1])
                    lines += _commands(dbn, a, i, guard, moves[a], levels[a][i], layered, possible)
                elif layered:
                    lines += [f"  [{moves[a][levels[a][i]]}] step={step} -> true;"]
                    lines += [f"  [{moves[a][-1]}] step={step} -> ({name}'=0);"]
                else:
                    lines += [f"  [{actions[a]}] step={step} -> ({name}'=0);"]
        lines.append("endmodule")
    return "\n".join(lines) + "\n"


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
        [action, *(f"{action}_{level}" for level in range(1, max(level_of) + 1)), f"{action}_end"]
        for action, level_of in zip(actions, levels, strict=True)
    ]


def _clock(moves: list[list[str]], plan: Sequence[int] | None, layered: bool) -> list[str]:
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
    possible: tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]] | None,
) -> list[str]:
    """The commands of one factor under one action; with `possible`, for those values of slice t and t+1 alone."""
    own = "y" if layered else "x"
    parents = dbn.parents(action, factor)
    names = [("y" if where else "x") + str(p) for where, p in parents]
    full = np.arange(dbn.num_values)
    sets = [full if possible is None else possible[where][p] for where, p in parents]
    tensor = dbn.tensor(action, factor)
    lines = []
    for values in itertools.product(*(column.tolist() for column in sets)):
        row = tensor[values]
        when = guard + (" & ".join(f"{n}={v}" for n, v in zip(names, values, strict=True)) or "true")
        then = " + ".join(f"{p!r}:({own}{factor}'={k})" for k, p in enumerate(row.tolist()) if p > 0)
        lines.append(f"  [{moves[level]}] {when} -> {then};")
    if layered:
        lines.append(f"  [{moves[-1]}] {guard}true -> (x{factor}'=y{factor}) & (y{factor}'=0);")
    return lines
