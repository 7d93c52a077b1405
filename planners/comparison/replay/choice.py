"""Which episodes of a comparison are played again: a rule that looks at results alone (see replay)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from planners.comparison.grid import Cell

MOST_EPISODES = 60
REASONS = ("first success", "first failure", "worst regret")


@dataclass(frozen=True)
class Chosen:
    """One episode to be played again.

    Attributes:
        episode: its number in the cell.
        reasons: of `REASONS`.
        total: its recorded return.
        outcome: its recorded outcome.
        regret: against the optimum; None where the optimum has not played the episode.
    """

    episode: int
    reasons: tuple[str, ...]
    total: float
    outcome: str
    regret: float | None


def choose(tables: dict[Cell, dict[str, list[Any]]], most: int = MOST_EPISODES) -> dict[Cell, list[Chosen]]:
    """The episodes to play again, by the rule of the module's head.

    Args:
        tables: per cell the columns `return`, `outcome` and `map_id` of its evaluation episodes.
        most: episodes in all; further ones are left out, the worst regrets last.
    """
    every = {cell: all_reasons(tables, cell) for cell in tables}
    left = most
    kept: dict[Cell, list[Chosen]] = {cell: [] for cell in tables}
    for reason in ("worst regret", "first success", "first failure"):
        for cell, candidates in every.items():
            for candidate in candidates:
                if reason in candidate.reasons and candidate not in kept[cell] and left > 0:
                    kept[cell].append(candidate)
                    left -= 1
    return {cell: sorted(picked, key=lambda c: c.episode) for cell, picked in kept.items()}


def all_reasons(tables: dict[Cell, dict[str, list[Any]]], cell: Cell) -> list[Chosen]:
    """Every episode of one cell that the rule names."""
    table = tables[cell]
    regrets = [_regret(tables, cell, episode) for episode in range(len(table["return"]))]
    picked: dict[int, list[str]] = {}
    successes = [episode for episode, outcome in enumerate(table["outcome"]) if outcome == "success"]
    failures = [episode for episode, outcome in enumerate(table["outcome"]) if outcome != "success"]
    known = [episode for episode, regret in enumerate(regrets) if regret is not None]
    if successes:
        picked.setdefault(successes[0], []).append("first success")
    if failures:
        picked.setdefault(failures[0], []).append("first failure")
    worst = max(known, key=lambda episode: (float(regrets[episode] or 0.0), -episode), default=None)
    if worst is not None and (regrets[worst] or 0.0) > 0:
        picked.setdefault(worst, []).append("worst regret")
    return [
        Chosen(episode, tuple(reasons), float(table["return"][episode]), table["outcome"][episode], regrets[episode])
        for episode, reasons in sorted(picked.items())
    ]


def _regret(tables: dict[Cell, dict[str, list[Any]]], cell: Cell, episode: int) -> float | None:
    """What the optimum got more on the same episode of the same map; None where it has not played it."""
    own = tables[cell]
    for other, table in tables.items():
        alike = (other.agent, other.variant, other.seed) == ("optimum", cell.variant, cell.seed)
        if alike and episode < len(table["return"]) and table["map_id"][episode] == own["map_id"][episode]:
            return float(table["return"][episode]) - float(own["return"][episode])
    return None
