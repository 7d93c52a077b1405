"""What values mean: short rules between factors and predicates, induced from the codebook and scored on held-out views.

Both directions: a predicate from factor values (`wall_ahead` if X2 in {0, 3} and X5 in {4}) and a factor value from
predicates. A decision tree finds candidate rules; values that a path leaves open become one set, and conditions that
a rule does not need are dropped again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nesy.dbn.codebook import Codebook
from nesy.errors import UserError


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
        return _applies(self.rules, values)


def predicate_rules(
    codebook: Codebook, predicate: str, held_out: float = 0.25, seed: int = 0, num_values: int | None = None
) -> RuleSet:
    """Rules for a predicate from the values of factors.

    Args:
        codebook: the views with their codes.
        predicate: its name.
        held_out: share of the distinct views kept for scoring; 0 to learn from all and score on all.
        seed: of the split.
        num_values: K; by default the largest value met, plus one.

    Raises:
        UserError: no such predicate, or no views.
    """
    k = num_values or int(codebook.codes.max(initial=0)) + 1
    return _rules(predicate, codebook.codes.astype(np.int64), codebook.predicate(predicate), k, held_out, seed)


def value_rules(
    codebook: Codebook,
    factor: int,
    value: int,
    predicates: Sequence[str] | None = None,
    held_out: float = 0.25,
    seed: int = 0,
) -> RuleSet:
    """Rules for `factor = value` from predicates (all of them by default).

    Raises:
        UserError: no such predicate, or no views.
    """
    names = codebook.predicate_names if predicates is None else tuple(predicates)
    truth = np.stack([codebook.predicate(name) for name in names], axis=1).astype(np.int64)
    target = codebook.codes[:, factor] == value
    return _rules(f"{factor}={value}", truth, target, 2, held_out, seed)


def _rules(target: str, values: np.ndarray, truth: np.ndarray, num_values: int, held_out: float, seed: int) -> RuleSet:
    if not len(values):
        raise UserError("there are no views to learn from")
    order = np.random.default_rng(seed).permutation(len(values))
    split = round(held_out * len(values))
    test, train = (order[:split], order[split:]) if split else (order, order)
    rules = _learn(values[train], truth[train], num_values)
    said, wanted = _applies(rules, values[test]), truth[test]
    right = int((said & wanted).sum())
    everywhere = _applies(rules, values)
    return RuleSet(
        target=target,
        rules=rules,
        precision=right / int(said.sum()) if said.any() else 1.0,
        recall=right / int(wanted.sum()) if wanted.any() else 1.0,
        accuracy=float((everywhere == truth).mean()),
        held_out=len(test),
    )


def _learn(values: np.ndarray, truth: np.ndarray, num_values: int) -> tuple[Rule, ...]:
    if not truth.any():
        return ()
    if truth.all():
        return (Rule((), len(truth), len(truth)),)
    from sklearn.tree import DecisionTreeClassifier

    columns = values.shape[1]
    one_hot = (values[:, :, None] == np.arange(num_values)).reshape(len(values), -1)
    tree = DecisionTreeClassifier(criterion="entropy", random_state=0).fit(one_hot, truth).tree_
    allowed = [np.ones((columns, num_values), dtype=bool)]
    found = []
    stack = [(0, allowed[0])]
    while stack:
        node, mask = stack.pop()
        if tree.children_left[node] < 0:
            share = tree.value[node][0]
            if share[1] > share[0]:
                found.append(mask)
            continue
        column, value = divmod(int(tree.feature[node]), num_values)
        without, only = mask.copy(), mask.copy()
        without[column, value] = False
        only[column] = False
        only[column, value] = mask[column, value]
        stack += [(tree.children_left[node], without), (tree.children_right[node], only)]
    return _simplified(found, values, truth)


def _simplified(masks: list[np.ndarray], values: np.ndarray, truth: np.ndarray) -> tuple[Rule, ...]:
    """Drop conditions and allow values as long as a rule says nothing more that is wrong; drop rules not needed."""
    columns = np.arange(values.shape[1])
    chosen = []
    for mask in masks:
        applies = mask[columns, values].all(axis=1)
        wrong = int((applies & ~truth).sum())
        general = mask.copy()
        # the condition that most values satisfy says least: try to do without it first
        for column in sorted(columns.tolist(), key=lambda c: (-mask[c].sum(), c)):
            wider = general.copy()
            wider[column] = True
            if int((wider[columns, values].all(axis=1) & ~truth).sum()) <= wrong:
                general = wider
                continue
            # values never met in this context stay out: a rule should not promise more than was seen
            for value in np.flatnonzero(~general[column]).tolist():
                wider = general.copy()
                wider[column, value] = True
                covered = wider[columns, values].all(axis=1)
                if covered.sum() > general[columns, values].all(axis=1).sum() and (covered & ~truth).sum() <= wrong:
                    general = wider
        chosen.append(general)
    covers = [mask[columns, values].all(axis=1) for mask in chosen]
    rules: list[Rule] = []
    covered = np.zeros(len(values), dtype=bool)
    for j in sorted(range(len(chosen)), key=lambda j: (-int((covers[j] & truth).sum()), j)):
        if not (covers[j] & truth & ~covered).any():
            continue
        covered |= covers[j]
        met = [np.unique(values[:, c]) for c in columns]
        conditions = tuple(
            (int(c), tuple(int(v) for v in met[c] if chosen[j][c, v]))
            for c in columns
            if not chosen[j][c, met[c]].all()
        )
        rules.append(Rule(conditions, int((covers[j] & truth).sum()), int(covers[j].sum())))
    return tuple(rules)


def _applies(rules: Sequence[Rule], values: np.ndarray) -> np.ndarray:
    result = np.zeros(len(values), dtype=bool)
    for rule in rules:
        here = np.ones(len(values), dtype=bool)
        for column, allowed in rule.conditions:
            here &= np.isin(values[:, column], allowed)
        result |= here
    return result


def asp_rules(rules: RuleSet, head: str, atom: str) -> str:
    """The rules as ASP text.

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


def readable(rules: RuleSet, names: Sequence[str], predicates: bool = False) -> str:
    """The rules as text for people; `names` of the factors, or of the predicates."""
    lines = []
    for rule in rules.rules:
        parts = [
            (names[c] if 1 in values else f"not {names[c]}")
            if predicates
            else f"{names[c]} in {{{', '.join(map(str, values))}}}"
            for c, values in rule.conditions
        ]
        lines.append(f"{rules.target} if {' and '.join(parts) or 'always'}  (right in {rule.right} of {rule.applies})")
    scores = f"held-out precision {rules.precision:.3f}, recall {rules.recall:.3f} ({rules.held_out} views)"
    return "\n".join([*lines, f"{scores}; on all views right in {100 * rules.accuracy:.1f} %"])


def summary(codebook: Codebook, held_out: float = 0.25, seed: int = 0) -> dict[str, Any]:
    """Scores of the rules for every predicate that the codes determine and that varies.

    Returns:
        `predicates` (how many), `macro_precision`, `macro_recall`, `per_predicate`.
    """
    scores = {}
    for name in determined(codebook):
        rules = predicate_rules(codebook, name, held_out, seed)
        scores[name] = {"precision": rules.precision, "recall": rules.recall, "rules": len(rules.rules)}
    values = list(scores.values())
    return {
        "predicates": len(scores),
        "macro_precision": float(np.mean([s["precision"] for s in values])) if values else 1.0,
        "macro_recall": float(np.mean([s["recall"] for s in values])) if values else 1.0,
        "per_predicate": scores,
    }


def determined(codebook: Codebook) -> tuple[str, ...]:
    """The predicates that hold in some views but not in all, and that no two views of one code disagree on."""
    _, index = codebook.distinct_codes()
    sizes = np.bincount(index)
    names = []
    for p, name in enumerate(codebook.predicate_names):
        truth = codebook.predicates[:, p]
        hits = np.bincount(index, weights=truth)
        if truth.any() and not truth.all() and ((hits == 0) | (hits == sizes)).all():
            names.append(name)
    return tuple(names)
