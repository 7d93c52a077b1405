"""Knowledge from people about the person, as a prior on the influence: moves that rules exclude get probability 0.

    rule file  ->  nesy.asp.Shield in the role of the person (checked and grounded once)
    y  ->  view that y means  ->  its predicates  ->  the rules  ->  moves that the person may take, mask [3]
    pi(u | y)  ->  pi(u | y) mask(u, y) / sum_u' pi(u' | y) mask(u', y)

`person_forbidden(forward) :- person_now(wall_ahead).` says that a person facing a wall does not walk forward. The
rules are asked for every code that experience holds; other codes are treated like the known ones that they share
their context with (the rows of a decision table). Where the rules exclude every move, they say nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import Domain
from nesy.asp.shield import PERSON, Shield
from nesy.errors import UserError
from planners.models.tables import DecisionTable
from planners.shielding import Decoder

if TYPE_CHECKING:
    from planners.person_following.ialm import IALM

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class InfluenceChange:
    """What rules changed in pi(u | y), over the known codes, each counted once."""

    codes: int
    """Known codes."""
    constrained: int
    """Of them, those for which some move is excluded."""
    conflicts: int
    """Of them, those for which every move is, so that the rules were not followed."""
    removed: float
    """Mean over the known codes of the probability that the excluded moves had."""
    most: float
    """Greatest such probability."""
    rows: int
    """Rows of the influence table afterwards."""
    rows_before: int
    """Rows before."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def constrain_influence(
    model: IALM, rules: Sequence[str | Path], codec: Decoder, domain: Domain, **limits: Any
) -> tuple[IALM, InfluenceChange | None]:
    """The model with an influence that keeps to the rules; the model itself where no rule is about the person.

    Args:
        model: the IALM.
        rules: rule files (`Path`) or texts (`str`), see docs/asp.md.
        codec: decodes codes.
        domain: evaluates predicates on the decoded views and names the actions.
        limits: of checking the rules, `time_limit` in seconds and `memory_mb`.

    Raises:
        UserError: a rule is wrong, contradicts others, or is about an action that is no move of the person's.
    """
    shield = Shield(
        rules,
        domain.spec.action_names,
        model.num_factors,
        model.num_values,
        tuple(domain.predicates.names),
        view_size=domain.spec.geometry.view_size,
        fallback="all",
        role=PERSON,
        **limits,
    )
    if not shield.speaks:
        return model, None
    codes = model.known_codes
    names = list(domain.predicates.names)
    columns = [names.index(name) for name in shield.predicates]
    truth = np.asarray(domain.predicates.evaluate(codec.views(codes))[:, columns], dtype=bool)
    possible = shield.mask(codes, truth, np.zeros(len(codes), np.int64))
    moves = model.tables["influence"].moments.shape[1]
    if not possible[:, moves:].all():
        allowed = ", ".join(domain.spec.action_names[:moves])
        raise UserError(f"person_forbidden: whether the person waits is no matter of its view; its moves are {allowed}")
    possible = possible[:, :moves]
    conflicts = ~possible.any(axis=1)
    possible[conflicts] = True
    before = model.influence_of(codes)
    removed = np.where(possible, 0.0, before).sum(axis=1)
    table = _constrained(model.tables["influence"], codes, possible)
    change = InfluenceChange(
        codes=len(codes),
        constrained=int((~possible).any(axis=1).sum()),
        conflicts=int(conflicts.sum()),
        removed=float(removed.mean()),
        most=float(removed.max(initial=0.0)),
        rows=table.rows,
        rows_before=model.tables["influence"].rows,
    )
    if change.conflicts:
        _LOG.warning("rules exclude every move of the person for %d codes, and are not followed there", conflicts.sum())
    return replace(model, tables={**model.tables, "influence": table}), change


def _constrained(table: DecisionTable, codes: np.ndarray, possible: np.ndarray) -> DecisionTable:
    """The table whose rows are split until the known codes in one agree on what is possible."""
    estimates = table.estimates()
    base = 2 * codes.shape[1]
    nodes: list[list[Any]] = []

    def add(node: int, here: np.ndarray) -> int:
        """Copy the part of the table under `node` for the known codes `here`; the number of its copy."""
        number = len(nodes)
        nodes.append([-1, 0, False, 0, 0, estimates[node]])
        if table.slot[node] >= 0:
            value = int(table.value[node])
            column = codes[here, table.slot[node] - base]
            met = column <= value if table.ordered[node] else column == value
            question = (int(table.slot[node]), value, bool(table.ordered[node]))
            below = (int(table.yes[node]), int(table.no[node]))
        elif len(here) == 0 or (possible[here] == possible[here[0]]).all():
            if len(here):
                kept = np.where(possible[here[0]], estimates[node], 0.0)
                even = possible[here[0]] / possible[here[0]].sum()
                nodes[number][5] = kept / kept.sum() if kept.sum() > 0 else even
            return number
        else:
            factor, value = _best_question(codes[here], possible[here])
            met = codes[here, factor] == value
            question, below = (base + factor, value, False), (node, node)
        yes = add(below[0], here[met])
        no = add(below[1], here[~met])
        nodes[number][:5] = [*question, yes, no]
        return number

    add(0, np.arange(len(codes)))
    slot, value, ordered, yes, no, chances = zip(*nodes, strict=True)
    names = table.names | {base + i: f"y{i}" for i in range(codes.shape[1])}
    return DecisionTable(
        np.array(slot, np.int32),
        np.array(value, np.int32),
        np.array(ordered, np.bool_),
        np.array(yes, np.int32),
        np.array(no, np.int32),
        np.array(chances),
        "given",
        names,
    )


def _best_question(codes: np.ndarray, possible: np.ndarray) -> tuple[int, int]:
    """(factor, value) whose question tells most about what is possible; codes that differ can be told apart."""
    _, kinds = np.unique(possible, axis=0, return_inverse=True)
    kinds = kinds.reshape(-1)
    best, chosen = np.inf, (0, 0)
    for factor in range(codes.shape[1]):
        for value in np.unique(codes[:, factor]):
            met = codes[:, factor] == value
            if met.all():
                continue
            rest = sum(_entropy(np.bincount(kinds[part])) for part in (met, ~met))
            if rest < best - 1e-12:
                best, chosen = rest, (factor, int(value))
    return chosen


def _entropy(counts: np.ndarray) -> float:
    """Entropy in nats, times the number."""
    held = counts[counts > 0]
    return float(-(held * np.log(held / held.sum())).sum())
