"""The three questions about meaning: what a value means, what an action changes, which values imply a predicate."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any

import clingo
import numpy as np

from nesy.asp.program.encoding import run_encoding
from nesy.asp.program.facts import Facts
from nesy.asp.program.names import encode
from nesy.dbn.codebook import Codebook
from nesy.errors import UserError

MOST_LINES = 8
SYMBOLS = ".#G~" + string.digits + string.ascii_uppercase.replace("G", "") + string.ascii_lowercase
"""Of the cell kinds, in their order: empty, wall, goal and unseen, then any others."""
CLEAR = 0.95
"""Share of the views in which a cell is of one kind for the picture to show it."""

Rows = list[dict[str, Any]]


def meaning_of(facts: Facts, book: Codebook, f: int, value: int, least: float) -> tuple[str, Rows]:
    """Text and rows: the predicates that `f = value` means, excludes, and leaves open."""
    dbn = facts.dbn
    program = facts.text(("predicate",)) + "\n".join(facts.cooccurs(factors=(f,)))
    # whole numbers of 64 bits here: products of two counts are too large for clingo
    chosen = book.codes[:, f] == value
    lift = np.sign(book.predicates[chosen].sum(axis=0) * len(book) - book.predicates.sum(axis=0) * chosen.sum())
    compared = "".join(
        f"{'oftener' if s > 0 else 'rarer'}({p})." for p, s in zip(facts.predicates, lift, strict=True) if s
    )
    atoms = run_encoding(("meaning",), f"asked({f},{value}). least({_percent(least)}). {compared} {program}")
    rows: list[dict[str, Any]] = [
        {
            "relation": atom.name,
            "predicate": _predicate(facts, book, atom),
            "views": atom.arguments[1].number,
            "of": atom.arguments[2].number,
            "of_all_views": _share(facts, book, atom),
        }
        for atom in atoms
        if atom.arguments
    ]
    order = {"means": 0, "excludes": 1, "mixed": 2}
    rows.sort(key=lambda r: (order[r["relation"]], -abs(r["views"] / r["of"] - r["of_all_views"]), r["predicate"]))
    name = f"{dbn.factor_names[f]} = {value}"
    return _meaning_text(name, rows, len(book)), rows


def changes_of(facts: Facts, a: int) -> tuple[str, Rows]:
    """Text and rows: the factors that an action changes, most often changed first, with their parents."""
    dbn = facts.dbn
    program = facts.text(("taken", "changed", "parent"))
    atoms = run_encoding(("influence",), f"asked({facts.actions[a]}). {program}")
    parents: dict[int, list[str]] = {i: [] for i in range(dbn.num_factors)}
    changes = dict.fromkeys(range(dbn.num_factors), (0, 0))
    for atom in atoms:
        numbers = [argument.number for argument in atom.arguments[1:]]
        if atom.name == "through":
            parents[numbers[0]].append(dbn.factor_names[numbers[1]] + ("'" if numbers[2] else ""))
        elif atom.name == "changes":
            changes[numbers[0]] = (numbers[1], numbers[2])
    rows: list[dict[str, Any]] = [
        {
            "factor": dbn.factor_names[i],
            "changed": changes[i][0],
            "of": changes[i][1],
            "parents": sorted(parents[i]),
        }
        for i in sorted(changes, key=lambda i: (-changes[i][0], i))
    ]
    name = dbn.action_names[a]
    moved = [r for r in rows if r["changed"]]
    lines = [f"'{name}' changes {len(moved)} of {len(rows)} factors:"]
    lines += [
        f"  {r['factor']}  in {_percentage(r['changed'], r['of'])} of {r['of']} transitions, "
        f"decided by {', '.join(r['parents']) or 'nothing'}"
        for r in moved
    ]
    kept = [r["factor"] for r in rows if not r["changed"]]
    if kept:
        lines.append(f"  never changed: {', '.join(kept)}")
    return "\n".join(lines), rows


def values_that_imply(facts: Facts, book: Codebook, predicate: str, least: float) -> tuple[str, Rows]:
    """Text and rows: values, alone or two together, with which a predicate holds."""
    dbn = facts.dbn
    truth = book.predicate(predicate)
    name = encode(predicate)
    program = "\n".join([*facts.cooccurs(predicates=(name,)), *facts.together(predicates=(name,))])
    atoms = run_encoding(("implies",), f"asked({name}). least({_percent(least)}). {program}")
    rows = []
    for atom in atoms:
        numbers = [argument.number for argument in atom.arguments]
        values = list(zip(numbers[:-2:2], numbers[1:-2:2], strict=True))
        covered = _having(book, values) & truth
        rows.append(
            {
                "values": [{"factor": dbn.factor_names[f], "value": v} for f, v in values],
                "views": numbers[-2],
                "of": numbers[-1],
                "covers": round(float(covered.sum() / max(1, truth.sum())), 4),
                "_covered": covered,
            }
        )
    rows.sort(key=lambda r: (len(r["values"]), -r["covers"], str(r["values"])))
    chosen, rows = _greedy_cover(rows)
    text = _implies_text(predicate, chosen, len(rows), int(truth.sum()), len(book))
    return text, rows


def _predicate(facts: Facts, book: Codebook, atom: clingo.Symbol) -> str:
    return book.predicate_names[facts.predicates.index(atom.arguments[0].name)]


def _share(facts: Facts, book: Codebook, atom: clingo.Symbol) -> float:
    return round(float(book.predicates[:, facts.predicates.index(atom.arguments[0].name)].mean()), 4)


def _meaning_text(name: str, rows: Sequence[dict[str, Any]], views: int) -> str:
    if not rows:
        return f"{name}: no view met in experience has this value."
    lines = [f"{name} ({rows[0]['of']} of {views} distinct views):"]
    words = {"means": "holds", "excludes": "does not hold"}
    for relation in words:
        chosen = [row for row in rows if row["relation"] == relation]
        for row in chosen[:MOST_LINES]:
            share = _percentage(row["views"], row["of"])
            lines.append(
                f"  {row['predicate']} {words[relation]}: true in {share} of them, "
                f"in {100 * row['of_all_views']:.1f} % of all views"
            )
        if len(chosen) > MOST_LINES:
            more = "hold" if relation == "means" else "do not hold"
            lines.append(f"  ... and {len(chosen) - MOST_LINES} more predicates that {more}")
    mixed = [r for r in rows if r["relation"] == "mixed"][:3]
    if len(lines) == 1:
        lines.append("  no predicate is decided by this value alone; the nearest:")
        lines += [
            f"  {r['predicate']}: true in {_percentage(r['views'], r['of'])} of them, "
            f"in {100 * r['of_all_views']:.1f} % of all views"
            for r in mixed
        ]
    return "\n".join(lines)


def _implies_text(predicate: str, chosen: Sequence[dict[str, Any]], total: int, positive: int, views: int) -> str:
    head = f"{predicate} holds in {positive} of {views} distinct views."
    if not chosen:
        return f"{head}\n  No value and no pair of values implies it."
    lines = [head, f"  {total} values or pairs imply it; these cover what can be covered:"]
    for row in chosen:
        values = " and ".join(f"{v['factor']} = {v['value']}" for v in row["values"])
        lines.append(
            f"  {values}: true in {row['views']} of {row['of']} views, covers {100 * row['covers']:.1f} % "
            f"of the views with {predicate} (so far {100 * row['covered_so_far']:.1f} %)"
        )
    return "\n".join(lines)


def _having(book: Codebook, values: Sequence[tuple[int, int]]) -> Any:
    """Which views have all the values (factor, value): bool [V]."""
    chosen = book.counts >= 0
    for factor, value in values:
        chosen = chosen & (book.codes[:, factor] == value)
    return chosen


def _greedy_cover(rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A small choice of rows that together cover all that any row covers; and the rows as plain data."""
    masks = [row.pop("_covered") for row in rows]
    if not rows:
        return [], []
    covered = masks[0] & False
    total = max(1.0, *(mask.sum() / max(row["covers"], 1e-9) for mask, row in zip(masks, rows, strict=True)))
    chosen: list[dict[str, Any]] = []
    while True:
        gains = [int((mask & ~covered).sum()) for mask in masks]
        best = max(range(len(rows)), key=lambda j: (gains[j], -len(rows[j]["values"]), -j))
        if not gains[best]:
            return chosen, rows
        covered = covered | masks[best]
        rows[best]["covered_so_far"] = round(float(covered.sum() / total), 4)
        chosen.append(rows[best])


def _percent(share: float) -> int:
    if not 0.5 < share <= 1:
        raise UserError(f"the least share must lie between 0.5 and 1, found {share}")
    return round(100 * share)


def _percentage(part: int, whole: int) -> str:
    return f"{100 * part / max(1, whole):.1f} %"


def mean_view(book: Codebook, factor: int, value: int) -> str:
    """The views with a value, laid over each other, in characters; the viewer stands at the bottom, looking up."""
    views = book.views[book.codes[:, factor] == value]
    kinds = len(book.cell_kinds)
    unclear = "?" if kinds <= len(SYMBOLS) else f"{'?':{len(str(kinds))}}"
    symbols = list(SYMBOLS) if kinds <= len(SYMBOLS) else [f"{kind:{len(unclear)}}" for kind in range(kinds)]
    shares = (views[..., None] == np.arange(kinds)).mean(axis=0)
    lines = []
    for y in range(views.shape[2]):
        cells = [
            symbols[int(shares[x, y].argmax())] if shares[x, y].max() >= CLEAR else unclear
            for x in range(views.shape[1])
        ]
        lines.append("    " + " ".join(cells))
    legend = ", ".join(f"{symbol} {kind}" for symbol, kind in zip(symbols, book.cell_kinds, strict=False))
    return "\n".join([*lines, f"    ({legend}; ? differs between the views)"])
