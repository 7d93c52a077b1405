"""Short rules as data: disjunctions of conjunctions over columns with few values, as ASP and as text.

A column is a factor (values 0 to K-1) or a predicate (values 0 and 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rule:
    """A conjunction: every condition allows a set of values."""

    conditions: tuple[tuple[int, tuple[int, ...]], ...]
    """(factor or predicate, allowed values), ascending; the values of a predicate are 0 and 1."""
    right: int
    """Views where the rule applies and is right."""
    applies: int
    """Views where the rule applies."""


@dataclass(frozen=True)
class RuleSet:
    """A disjunction of rules for one predicate or one value, with its scores."""

    target: str
    """What is concluded."""
    rules: tuple[Rule, ...]
    """The most general rules first."""
    precision: float
    """On the held-out views: of those where a rule applies, where the target holds; 1 if none applies."""
    recall: float
    """On the held-out views: of those where the target holds, where a rule applies; 1 if it holds nowhere."""
    accuracy: float
    """On all views."""
    held_out: int
    """Number of held-out views."""

    @property
    def length(self) -> int:
        """Conditions of all rules together."""
        return sum(len(rule.conditions) for rule in self.rules)

    def applies(self, values: np.ndarray) -> np.ndarray:
        """Where some rule applies: bool [n] for values integers [n, C]."""
        return applies(self.rules, values)


def applies(rules: Sequence[Rule], values: np.ndarray) -> np.ndarray:
    """Where some rule applies: bool [n] for values integers [n, C]."""
    result = np.zeros(len(values), dtype=bool)
    table = np.zeros(int(values.max(initial=0)) + 1, dtype=bool)
    for rule in rules:
        here = np.ones(len(values), dtype=bool)
        for column, allowed in rule.conditions:
            table[:] = False
            table[[v for v in allowed if v < len(table)]] = True
            here &= table[values[:, column]]
        result |= here
    return result


def counted(conditions: Sequence[tuple[int, tuple[int, ...]]], values: np.ndarray, truth: np.ndarray) -> Rule:
    """The rule with these conditions, with its counts on views."""
    here = applies([Rule(tuple(conditions), 0, 0)], values)
    return Rule(tuple(conditions), int((here & truth).sum()), int(here.sum()))


def scored(target: str, rules: tuple[Rule, ...], values: np.ndarray, truth: np.ndarray, test: np.ndarray) -> RuleSet:
    """Rules with their scores.

    Args:
        target: what they conclude.
        rules: the rules.
        values: integers [n, C], all views.
        truth: bool [n], where the target holds.
        test: integers, the views to score precision and recall on.
    """
    said = applies(rules, values)
    right = int((said & truth)[test].sum())
    predicted, wanted = int(said[test].sum()), int(truth[test].sum())
    return RuleSet(
        target=target,
        rules=rules,
        precision=right / predicted if predicted else 1.0,
        recall=right / wanted if wanted else 1.0,
        accuracy=float((said == truth).mean()) if len(truth) else 1.0,
        held_out=len(test),
    )


def asp_rules(rules: RuleSet, head: str, atom: str) -> str:
    """Rules over factors as ASP text.

    Args:
        rules: rules over factors.
        head: the head, for example `now(wall_ahead)`.
        atom: the predicate of factor values, for example `at` for at(F,V).
    """
    lines = []
    for rule in rules.rules:
        # a set of values is a cardinality condition: a pool would multiply into one rule per combination
        body = ", ".join(
            f"{atom}({f},{values[0]})"
            if len(values) == 1
            else f"1 {{ {'; '.join(f'{atom}({f},{v})' for v in values)} }}"
            for f, values in rule.conditions
        )
        lines.append(f"{head} :- {body}." if body else f"{head}.")
    return "\n".join(lines)


def asp_value_rules(rules: RuleSet, head: str, atom: str, names: Sequence[str]) -> str:
    """Rules over predicates as ASP text.

    Args:
        rules: rules over predicates.
        head: the head, for example `at(3,5)`.
        atom: the predicate of what holds, for example `now` for now(P).
        names: the predicates' ASP constants, by column.
    """
    lines = []
    for rule in rules.rules:
        body = ", ".join(
            f"{atom}({names[column]})" if 1 in values else f"not {atom}({names[column]})"
            for column, values in rule.conditions
        )
        lines.append(f"{head} :- {body}." if body else f"{head}.")
    return "\n".join(lines)


def sentence(rule: Rule, names: Sequence[str], predicates: bool = False) -> str:
    """The conditions of one rule for people; `names` of the factors, or of the predicates."""
    parts = [
        (names[c] if 1 in values else f"not {names[c]}")
        if predicates
        else f"{names[c]} = {values[0]}"
        if len(values) == 1
        else f"{names[c]} in {{{', '.join(map(str, values))}}}"
        for c, values in rule.conditions
    ]
    return " and ".join(parts) or "always"


def readable(rules: RuleSet, names: Sequence[str], predicates: bool = False) -> str:
    """The rules as text for people; `names` of the factors, or of the predicates."""
    lines = [
        f"{rules.target} if {sentence(rule, names, predicates)}  (right in {rule.right} of {rule.applies})"
        for rule in rules.rules
    ]
    if not rules.rules:
        lines = [f"{rules.target}: never, in the views learned from"]
    scores = f"held-out precision {rules.precision:.3f}, recall {rules.recall:.3f} ({rules.held_out} views)"
    return "\n".join([*lines, f"{scores}; on all views right in {100 * rules.accuracy:.1f} %"])
