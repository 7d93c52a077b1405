"""Ready questions about meaning: values, predicates, and what actions change."""

from __future__ import annotations

import time

from nesy.asp.finding import Edge, Finding, finding
from nesy.asp.program.names import encode
from nesy.asp.questions.subject import Subject
from nesy.asp.semantics.meaning import changes_of, mean_view, meaning_of, values_that_imply
from nesy.errors import UserError

MOST_RULES = 3
"""Of the rules for a value, the meaning shows so many."""


class MeaningQuestions(Subject):
    """What values mean, in both directions, and what actions change."""

    def means(self, factor: int | str, value: int, least: float = 0.95) -> Finding:
        """What does factor F = V mean? The predicates that it implies, a picture, and a rule that says when it holds.

        Args:
            factor: number or name of the factor.
            value: the value.
            least: share of the views with the value in which a predicate must hold to be implied.

        Raises:
            UserError: no such factor or value.
        """
        started = time.perf_counter()
        f, name = self._value(factor, value)
        text, rows = meaning_of(self.facts, self.book, f, value, least)
        support: list[Edge] = [
            (name, row["predicate"] if row["relation"] == "means" else f"not {row['predicate']}", _share(row))
            for row in rows
            if row["relation"] != "mixed"
        ]
        if rows:
            rule, sentences = self._value_rule(f, value)
            text = f"{text}\n{rule}\n{mean_view(self.book, f, value)}"
            support = [(sentence, name, "rule") for sentence in sentences] + support
        return finding(f"What does {name} mean?", text, rows, started, support)

    def value_rules(self, factor: int | str, value: int, held_out: float = 0.25) -> Finding:
        """Which rules over predicates say when factor F = V?

        Raises:
            UserError: no such factor or value.
        """
        from nesy.asp.semantics.predicates import ordered, value_rules
        from nesy.asp.semantics.rules import asp_value_rules, readable, sentence

        started = time.perf_counter()
        f, name = self._value(factor, value)
        names = ordered(self.book.predicate_names)
        found = value_rules(self.book, f, value, held_out=held_out)
        row = {
            "precision": found.precision,
            "recall": found.recall,
            "accuracy": found.accuracy,
            "rules": len(found.rules),
            "conditions": found.length,
            "asp": asp_value_rules(found, f"at({f},{value})", "now", [encode(n) for n in names]),
        }
        support = [(sentence(rule, names, True), name, f"{rule.right} of {rule.applies} views") for rule in found.rules]
        text = readable(found, names, predicates=True).replace(found.target, name)
        return finding(f"When is {name}?", text, [row], started, support)

    def _value(self, factor: int | str, value: int) -> tuple[int, str]:
        """The number of a factor, and what `factor = value` is called.

        Raises:
            UserError: no such factor or value.
        """
        f = self.factor(factor)
        if not 0 <= value < self.dbn.num_values:
            raise UserError(f"no value {value}; the values of a factor are 0 to {self.dbn.num_values - 1}")
        return f, f"{self.dbn.factor_names[f]} = {value}"

    def _value_rule(self, f: int, value: int) -> tuple[str, list[str]]:
        """The rule for a value learned from all views, as a line, and its conjunctions."""
        from nesy.asp.semantics.predicates import ordered, value_rules
        from nesy.asp.semantics.rules import sentence

        found = value_rules(self.book, f, value, held_out=0.0)
        names = ordered(self.book.predicate_names)
        sentences = [sentence(rule, names, True) for rule in found.rules]
        exact = "exactly if" if found.accuracy == 1.0 else f"(right in {100 * found.accuracy:.1f} % of views) if"
        shown = "; or ".join(sentences[:MOST_RULES]) or "never"
        more = f"; or ... ({len(sentences) - MOST_RULES} more)" if len(sentences) > MOST_RULES else ""
        return f"  it holds {exact} {shown}{more}", sentences

    def influenced(self, action: int | str) -> Finding:
        """Which factors does action A change, and through which parents?

        Raises:
            UserError: no such action.
        """
        started = time.perf_counter()
        a = self.action(action)
        text, rows = changes_of(self.facts, a)
        support = [(parent, f"{row['factor']}'", "") for row in rows if row["changed"] for parent in row["parents"]]
        return finding(f"Which factors does '{self.dbn.action_names[a]}' change?", text, rows, started, support)

    def implies(self, predicate: str, least: float = 0.95) -> Finding:
        """Which values, alone or two together, mean that a predicate holds?

        Args:
            predicate: name of an observable predicate.
            least: share of the views with the value in which the predicate must hold.

        Raises:
            UserError: no such predicate.
        """
        started = time.perf_counter()
        text, rows = values_that_imply(self.facts, self.book, predicate, least)
        support = [
            (" and ".join(f"{v['factor']} = {v['value']}" for v in row["values"]), predicate, _share(row))
            for row in rows
        ]
        return finding(f"Which values mean that {predicate} holds?", text, rows, started, support)

    def rules(self, predicate: str, held_out: float = 0.25) -> Finding:
        """Which rules over factor values say when a predicate holds?

        Raises:
            UserError: no such predicate.
        """
        from nesy.asp.semantics.predicates import predicate_rules
        from nesy.asp.semantics.rules import asp_rules, readable, sentence

        started = time.perf_counter()
        found = predicate_rules(self.book, predicate, held_out, num_values=self.dbn.num_values)
        row = {
            "precision": found.precision,
            "recall": found.recall,
            "accuracy": found.accuracy,
            "rules": len(found.rules),
            "conditions": found.length,
            "asp": asp_rules(found, f"now({encode(predicate)})", "at"),
        }
        names = self.dbn.factor_names
        support = [(sentence(rule, names), predicate, f"{rule.right} of {rule.applies} views") for rule in found.rules]
        return finding(f"When does {predicate} hold?", readable(found, names), [row], started, support)


def _share(row: dict[str, int]) -> str:
    return f"{row['views']} of {row['of']} views"
