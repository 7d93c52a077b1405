"""RDDL for pyRDDLGym: every table is a non-fluent indexed by the parents' values.

Rows are many and RDDL is read slowly, so above `MAX_ENTRIES` only the rows met in experience are written; all
others are then uniform, and the file says so. Where these are still too many, improbable entries are left out too
(`LEAST`, the smallest that suffices): rows are weights then, divided by their sum when a value is drawn, and the file
says how far a row is at most from the model's in total variation.

Where the model has them, the reward is a table of step means, and the state fluent `done` becomes true with the
termination table's probability; rows of these two that were never met pay nothing and end nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nesy import names
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.step_tables import StepTable
from nesy.errors import UserError
from nesy.formats.prism import named
from nesy.run_folder import atomic_path

NAMES = names.Grammar(never=r"_(?![A-Za-z0-9])", prefix="do_")
"""Names of actions: pyRDDLGym takes no name that ends in `_`, and has `__` for grounded names."""

MAX_ENTRIES = 200_000
LEAST = (1e-6, 1e-4, 1e-3)
NEGLIGIBLE = 1e-12
"""Weight of an entry that is left out: so a row without any entry is uniform."""


def write(dbn: TwoSliceDBN, path: Path, start: np.ndarray | None = None, horizon: int = 100) -> None:
    """Write the domain to `path` and the instance to `NAME_instance.rddl` beside it.

    Args:
        dbn: the model.
        path: the domain's file.
        start: integers [N]: the initial code; by default each factor's most probable initial value.
        horizon: steps of an episode.

    Raises:
        UserError: the rows met in experience are too many for this format.
    """
    every = dbn.probabilities.size <= MAX_ENTRIES
    # where experience is not known, every row counts
    told = dbn.row_counts > 0 if dbn.row_counts.any() else np.ones(len(dbn.row_counts), dtype=bool)
    met = dbn.probabilities[told]
    least = 0.0
    if not every and met.size > MAX_ENTRIES:
        fitting = [p for p in LEAST if (met >= p).sum() <= MAX_ENTRIES]
        if not fitting:
            raise UserError(f"RDDL files hold at most {MAX_ENTRIES} probabilities; use another format, e.g. parquet")
        least = fitting[0]
    code = dbn.initial.argmax(axis=1) if start is None else np.asarray(start)
    actions = [NAMES.encode(name) for name in dbn.action_names]
    every = every or bool(told.all())
    remarks = [] if every else ["// Rows never met in experience are uniform here."]
    if least:
        apart = np.where(met < least, met, 0.0).sum(axis=1).max()
        off = f"a row is at most {apart:.2g} from the model's in total variation"
        remarks.append(f"// Entries below {least:g} are left out; {off}.")
    domain = "\n".join([*remarks, *names.remarks(named(dbn, NAMES), "//"), _domain(dbn, actions, least)])
    with atomic_path(path) as temporary:
        temporary.write_text(domain, encoding="utf-8")
    with atomic_path(path.with_name(f"{path.stem}_instance{path.suffix}")) as temporary:
        temporary.write_text(_instance(dbn, code, horizon, every, least), encoding="utf-8")


def _domain(dbn: TwoSliceDBN, actions: list[str], least: float) -> str:
    draw, default = ("UnnormDiscrete", NEGLIGIBLE) if least else ("Discrete", 1.0 / dbn.num_values)
    values = ", ".join(f"@v{k}" for k in range(dbn.num_values))
    lines = ["domain dbn {", f"  types {{ val : {{ {values} }}; }};", "  pvariables {"]
    for a in range(dbn.num_actions):
        for i in range(dbn.num_factors):
            types = ", ".join(["val"] * (len(dbn.parents(a, i)) + 1))
            lines.append(f"    p_{a}_{i}({types}) : {{ non-fluent, real, default = {default:.17f} }};")
    for name, table in _outcomes(dbn).items():
        for a in range(dbn.num_actions):
            types = ", ".join(["val"] * len(table.parents(a, 0)))
            kind = f"({types})" if types else ""
            lines.append(f"    {name}_{a}{kind} : {{ non-fluent, real, default = 0.0 }};")
    if "termination" in dbn.step_tables:
        lines.append("    done : { state-fluent, bool, default = false };")
    lines += [f"    x{i} : {{ state-fluent, val, default = @v0 }};" for i in range(dbn.num_factors)]
    lines += [f"    {action} : {{ action-fluent, bool, default = false }};" for action in actions]
    lines += ["  };", "  cpfs {"]
    for i in range(dbn.num_factors):
        # no action: everything stays
        branches = f"x{i}"
        for a in reversed(range(dbn.num_actions)):
            parents = [f"x{p}" + ("'" if where else "") for where, p in dbn.parents(a, i)]
            index = ", ".join([*parents, "?v"])
            branches = f"if ({actions[a]}) then {draw}_{{?v : val}}(p_{a}_{i}({index})) else ({branches})"
        lines.append(f"    x{i}' = {branches};")
    ends = "termination" in dbn.step_tables
    if ends:
        branches = _by_action(dbn, actions, "ends", "Bernoulli({})", "false")
        lines.append(f"    done' = if (done) then true else ({branches});")
    pay = _by_action(dbn, actions, "pays", "{}", "0.0") if "reward" in dbn.step_tables else "0"
    lines += ["  };", f"  reward = {pay};"]
    return "\n".join([*lines, *(["  termination { done; };"] if ends else []), "}"]) + "\n"


def _outcomes(dbn: TwoSliceDBN) -> dict[str, StepTable]:
    """Step tables of the file by the name of their non-fluents."""
    tables = {"pays": "reward", "ends": "termination"}
    return {name: dbn.step_tables[table] for name, table in tables.items() if table in dbn.step_tables}


def _by_action(dbn: TwoSliceDBN, actions: list[str], name: str, form: str, otherwise: str) -> str:
    """An expression that looks a step table up for the action taken."""
    branches = otherwise
    for a in reversed(range(dbn.num_actions)):
        parents = [f"x{p}" + ("'" if where else "") for where, p in _outcomes(dbn)[name].parents(a, 0)]
        index = f"({', '.join(parents)})" if parents else ""
        branches = f"if ({actions[a]}) then {form.format(f'{name}_{a}{index}')} else ({branches})"
    return branches


def _entries(dbn: TwoSliceDBN) -> list[str]:
    """The numbers of the step tables that are not 0."""
    lines = []
    for name, table in _outcomes(dbn).items():
        for a in range(dbn.num_actions):
            column = -1 if table.outcomes else 0
            values, shape = table.table(a, 0)[:, column], (dbn.num_values,) * len(table.parents(a, 0))
            for row in np.flatnonzero((table.counts(a, 0) > 0) & (np.abs(values) > 1e-9)).tolist():
                index = ", ".join(f"@v{v}" for v in np.unravel_index(row, shape)) if shape else ""
                place = f"({index})" if index else ""
                lines.append(f"    {name}_{a}{place} = {_number(values[row])};")
    return lines


def _number(value: float) -> str:
    """All digits, and at least one after the point: `1.` is no number in RDDL."""
    return np.format_float_positional(value, trim="0")


def _instance(dbn: TwoSliceDBN, code: np.ndarray, horizon: int, every: bool, least: float) -> str:
    lines = ["non-fluents tables {", "  domain = dbn;", "  non-fluents {"]
    for a in range(dbn.num_actions):
        for i in range(dbn.num_factors):
            table, counts = dbn.cpt(a, i), dbn.counts(a, i)
            shape = (dbn.num_values,) * len(dbn.parents(a, i))
            for row in range(len(table)) if every else np.flatnonzero(counts).tolist():
                context = np.unravel_index(row, shape) if shape else ()
                for k in np.flatnonzero(table[row] >= least).tolist():
                    index = ", ".join(f"@v{v}" for v in (*context, k))
                    lines.append(f"    p_{a}_{i}({index}) = {_number(table[row, k])};")
    lines += _entries(dbn)
    start = " ".join(f"x{i} = @v{int(v)};" for i, v in enumerate(code))
    lines += ["  };", "}", "instance start {", "  domain = dbn;", "  non-fluents = tables;"]
    lines += [f"  init-state {{ {start} }};", "  max-nondef-actions = 1;", f"  horizon = {horizon};"]
    return "\n".join([*lines, "  discount = 1.0;", "}"]) + "\n"
