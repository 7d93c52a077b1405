"""Named factors: a factor whose value is the answer to a few questions about the view.

A question is an observable predicate of the view. A group of questions makes a factor if its joint answers take at
most K forms on the views that can be met; each form is one value. Whoever knows the value knows every answer, and
the value of a view never met follows from its answers.

The groups are found by simulated annealing. A move adds a question to a group, takes one out, or exchanges one. It
is judged by what it takes to say the next view, in nats: the next code under the 2DBN, the view given its code, and
a bonus for every question that some factor answers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from domains.core import CELL_KINDS
from nesy.compiled import njit
from nesy.world_model.codes.counting import Counts, Edges, Families, count, count_type, families_of, shift_edge, x_log_x
from nesy.world_model.codes.refinement import CodeBook, Refiner

MOST_QUESTIONS = 8
"""Questions in one group at most."""
FEWEST = 20
"""Weight that every view has at least where views are told apart, in transitions."""
PROPOSALS = 12
"""Proposals drawn for every move tried; most would need more than K values and cost next to nothing."""
ADD, EXCHANGE, REMOVE = 0.35, 0.4, 0.1
"""Shares of the kinds of proposal; the rest takes out one question and exchanges another."""


@dataclass(frozen=True)
class Questions:
    """What can be asked: answers on the distinct views, no two questions with the same ones."""

    names: tuple[str, ...]
    answers: np.ndarray
    """int64 [V, Q] of 0 and 1; each question has both answers."""

    @classmethod
    def of(cls, names: tuple[str, ...], truth: np.ndarray, wanted: tuple[str, ...] = ()) -> Questions:
        """The distinct questions among predicates bool [V, P].

        Of those that always agree one in `wanted` is kept, or else the one with the shortest name.
        """
        order = sorted(range(len(names)), key=lambda p: (names[p] not in wanted, len(names[p]), p))
        varies = np.array([p for p in order if truth[:, p].any() and not truth[:, p].all()], dtype=np.int64)
        _, first = np.unique(truth[:, varies], axis=1, return_index=True)
        kept = np.sort(varies[first])
        return cls(tuple(names[p] for p in kept), np.ascontiguousarray(truth[:, kept].astype(np.int64)))

    @classmethod
    def about_cells(cls, views: np.ndarray) -> Questions:
        """Which kind every cell is, where no domain offers predicates; views uint8 [V, v, v]."""
        size = views.shape[1]
        places = [(kind, x, y) for kind in range(len(CELL_KINDS)) for x in range(size) for y in range(size)]
        truth = np.stack([views[:, x, y] == kind for kind, x, y in places], axis=1)
        return cls.of(tuple(f"cell_{CELL_KINDS[kind]}_{x}_{y}" for kind, x, y in places), truth)

    def entropy(self) -> np.ndarray:
        """Entropy of every answer over the views, float64 [Q], in nats."""
        share = self.answers.mean(0)
        return np.asarray(-share * np.log(share) - (1 - share) * np.log(1 - share))

    def values(self, group: np.ndarray, num_values: int) -> np.ndarray | None:
        """Values int64 [V] of the factor that a group [M] of questions (-1: none) makes; None if they are too many."""
        key = np.zeros(len(self.answers), dtype=np.int64)
        _joint(self.answers, group, key)
        values = np.zeros(len(key), dtype=np.int64)
        if _values(key, np.zeros_like(key), np.ones_like(key), num_values, values) > num_values:
            return None
        return values

    def meanings(self, group: np.ndarray, values: np.ndarray) -> dict[str, Any]:
        """The questions of a group, and what every value answers to them, as JSON values."""
        asked = [int(q) for q in group if q >= 0]
        return {
            "questions": [self.names[q] for q in asked],
            "answers": {
                str(value): [bool(self.answers[values == value][0, q]) for q in asked] for value in np.unique(values)
            },
        }


class _Search(NamedTuple):
    """What the moves work on, changed in place."""

    groups: np.ndarray
    """int64 [N, M], -1 where there is none."""
    codes: np.ndarray
    """int64 [V, N]."""
    told: np.ndarray
    """bool [N, Q]: whether the factor answers the question."""
    taken: np.ndarray
    """[K ** N]: weight of the views with a code; see `count_type`."""


class GroupSearch:
    """Finds the groups; all state is in the groups and the code book."""

    def __init__(self, questions: Questions, refiner: Refiner, fixed: dict[int, tuple[str, ...]], told: float) -> None:
        """Prepare a search.

        Args:
            questions: what can be asked.
            refiner: of the transitions; its structure search is used.
            fixed: questions that a factor must keep; those with one answer only are left out.
            told: bonus of a question that one factor answers: nats per transition for each nat of its entropy.
        """
        self.questions, self.refiner = questions, refiner
        t = refiner.transitions
        mass = np.bincount(t.target, t.weight, minlength=t.num_views)
        self._mass = np.maximum(mass, FEWEST).astype(np.int64)
        self._total = float(t.weight.sum())
        self._bonus = told * self._total * questions.entropy()
        known = {name: place for place, name in enumerate(questions.names)}
        self._fixed = {i: [known[name] for name in names if name in known] for i, names in fixed.items()}

    def start(self, num_factors: int, rng: np.random.Generator) -> tuple[np.ndarray, CodeBook]:
        """Groups of up to three random questions, int64 [N, M], and their codes."""
        groups = np.full((num_factors, MOST_QUESTIONS), -1, dtype=np.int64)
        columns = []
        for i in range(num_factors):
            drawn = rng.permutation(len(self.questions.names))
            for q in [*self._fixed.get(i, []), *drawn[:3]][: max(3, len(self._fixed.get(i, [])))]:
                place = int((groups[i] >= 0).sum())
                groups[i, place] = q
                if q in groups[i, :place] or self.questions.values(groups[i], self.refiner.num_values) is None:
                    groups[i, place] = -1
            values = self.questions.values(groups[i], self.refiner.num_values)
            assert values is not None
            columns.append(values)
        return groups, self.refiner.search(np.stack(columns, axis=1))

    def improve(
        self,
        groups: np.ndarray,
        book: CodeBook,
        factors: list[int],
        moves: int,
        temperature: float,
        collision: float,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, CodeBook, int]:
        """One round of annealing, then a new search of the structure.

        Args:
            groups: int64 [N, M].
            book: their codes.
            factors: those whose groups may change.
            moves: tried in this round.
            temperature: in nats per transition, 0 for moves that improve alone.
            collision: price of a nat that the codes do not say about the view.
            rng: draws the proposals.

        Returns:
            The new groups, their codes, and the number of moves made.
        """
        refiner, answers = self.refiner, self.questions.answers
        num_views, num_factors = book.codes.shape
        families = families_of(book.structure)
        counts = count(book.codes, refiner.edges, families, refiner.num_values, refiner.logs)
        search = _Search(
            groups.copy(),
            book.codes.copy(),
            np.zeros((num_factors, answers.shape[1]), dtype=np.bool_),
            np.zeros(self.refiner.num_values**num_factors, dtype=count_type(self._mass)),
        )
        for i in range(num_factors):
            _answered(answers, search.codes[:, i], refiner.num_values, search.told[i])
        _place(1, np.ones(num_views, dtype=np.bool_), search, self._mass, refiner.num_values, refiner.logs)
        kept = np.array([len(self._fixed.get(i, [])) for i in range(num_factors)], dtype=np.int64)
        proposals = rng.random((PROPOSALS * moves, 6))
        made = _anneal(
            proposals, np.array(factors, dtype=np.int64), moves, temperature * self._total, collision, self._bonus,
            kept, answers, self._mass, search, refiner.edges, families, counts, refiner.num_values,
        )  # fmt: skip
        return search.groups, refiner.search(search.codes, book.structure), int(made)


@njit(cache=True)
def _joint(answers: np.ndarray, group: np.ndarray, key: np.ndarray) -> None:
    for v in range(len(key)):
        joint = 0
        for q in group:
            if q >= 0:
                joint = 2 * joint + answers[v, q]
        key[v] = joint


@njit(cache=True)
def _values(key: np.ndarray, old: np.ndarray, mass: np.ndarray, num_values: int, new: np.ndarray) -> int:
    """Number the distinct keys so that most views keep their old value; returns how many, K + 1 if too many."""
    forms = np.zeros(num_values, dtype=np.int64)
    shared = np.zeros((num_values, num_values), dtype=np.int64)
    found = 0
    for v in range(len(key)):
        form = 0
        while form < found and forms[form] != key[v]:
            form += 1
        if form == found:
            if found == num_values:
                return num_values + 1
            forms[found] = key[v]
            found += 1
        new[v] = form
        shared[form, old[v]] += mass[v]
    number = np.full(num_values, -1, dtype=np.int64)
    used = np.zeros(num_values, dtype=np.bool_)
    for _ in range(found):
        best, best_form, best_value = -1, 0, 0
        for form in range(found):
            for value in range(num_values):
                if number[form] < 0 and not used[value] and shared[form, value] > best:
                    best, best_form, best_value = shared[form, value], form, value
        number[best_form] = best_value
        used[best_value] = True
    for v in range(len(key)):
        new[v] = number[new[v]]
    return found


@njit(cache=True)
def _answered(answers: np.ndarray, column: np.ndarray, num_values: int, told: np.ndarray) -> None:
    """Which questions the values of a factor answer."""
    num_questions = answers.shape[1]
    size = np.zeros(num_values, dtype=np.int64)
    yes = np.zeros((num_values, num_questions), dtype=np.int64)
    for v in range(len(column)):
        size[column[v]] += 1
        for q in range(num_questions):
            yes[column[v], q] += answers[v, q]
    for q in range(num_questions):
        told[q] = True
        for value in range(num_values):
            if yes[value, q] != 0 and yes[value, q] != size[value]:
                told[q] = False


@njit(cache=True)
def _reward(told: np.ndarray, bonus: np.ndarray) -> float:
    total = 0.0
    for q in range(told.shape[1]):
        for i in range(told.shape[0]):
            if told[i, q]:
                total += bonus[q]
                break
    return total


@njit(cache=True)
def _place(
    sign: int, changed: np.ndarray, search: _Search, mass: np.ndarray, num_values: int, logs: np.ndarray
) -> float:
    """Add or remove the codes of changed views; returns the change of the views' entropy given their codes."""
    change = 0.0
    for v in range(len(changed)):
        if changed[v]:
            key = 0
            for i in range(search.codes.shape[1]):
                key = key * num_values + search.codes[v, i]
            before = search.taken[key]
            after = before + sign * mass[v]
            change += x_log_x(after, logs) - x_log_x(before, logs) - sign * x_log_x(mass[v], logs)
            search.taken[key] = after
    return change


@njit(cache=True)
def _recode(
    factor: int, changed: np.ndarray, column: np.ndarray, collision: float, mass: np.ndarray, search: _Search,
    edges: Edges, families: Families, counts: Counts, num_values: int,
) -> float:  # fmt: skip
    """Give the changed views their values in `column`; returns the change of the cost in nats times weight."""
    change = 0.0
    for sign in (-1, 1):
        if sign > 0:
            for v in range(len(column)):
                if changed[v]:
                    search.codes[v, factor] = column[v]
        for e in range(len(edges.source)):
            before, after = changed[edges.source[e]], changed[edges.target[e]]
            if before or after:
                change += shift_edge(sign, e, before, after, factor, search.codes, edges, families, counts, num_values)
        change += collision * _place(sign, changed, search, mass, num_values, counts.logs)
    return change


@njit(cache=True)
def _propose(draw: np.ndarray, group: np.ndarray, kept: int, num_questions: int, new: np.ndarray) -> bool:
    """Write the group that a draw [6] proposes; False where there is none."""
    new[:] = group
    size = 0
    while size < len(group) and group[size] >= 0:
        size += 1
    kind, question = draw[1], int(draw[2] * num_questions)
    if kind >= ADD + EXCHANGE:
        if size <= kept or size < 2:
            return False
        out = kept + int(draw[3] * (size - kept))
        size -= 1
        new[out] = new[size]
        new[size] = -1
        if kind < ADD + EXCHANGE + REMOVE:
            return True
    if kind < ADD:
        if size == len(group):
            return False
        place = size
    else:
        if size <= kept:
            return False
        place = kept + int(draw[4] * (size - kept))
    for other in range(size):
        if new[other] == question:
            return False
    new[place] = question
    return True


@njit(cache=True)
def _anneal(
    proposals: np.ndarray, factors: np.ndarray, moves: int, temperature: float, collision: float, bonus: np.ndarray,
    kept: np.ndarray, answers: np.ndarray, mass: np.ndarray, search: _Search, edges: Edges, families: Families,
    counts: Counts, num_values: int,
) -> int:  # fmt: skip
    num_views = len(search.codes)
    group = np.zeros(search.groups.shape[1], dtype=np.int64)
    key = np.zeros(num_views, dtype=np.int64)
    column, old = np.zeros_like(key), np.zeros_like(key)
    changed = np.zeros(num_views, dtype=np.bool_)
    told = np.zeros(answers.shape[1], dtype=np.bool_)
    reward = _reward(search.told, bonus)
    tried, made = 0, 0
    for step in range(len(proposals)):
        if tried == moves:
            break
        draw = proposals[step]
        i = factors[int(draw[0] * len(factors))]
        if not _propose(draw, search.groups[i], kept[i], answers.shape[1], group):
            continue
        _joint(answers, group, key)
        old[:] = search.codes[:, i]
        if _values(key, old, mass, num_values, column) > num_values:
            continue
        any_changed = False
        for v in range(num_views):
            changed[v] = column[v] != old[v]
            any_changed = any_changed or changed[v]
        if not any_changed:
            search.groups[i] = group
            continue
        tried += 1
        cost = _recode(i, changed, column, collision, mass, search, edges, families, counts, num_values)
        told[:] = search.told[i]
        _answered(answers, column, num_values, search.told[i])
        then = _reward(search.told, bonus)
        cost -= then - reward
        if cost <= 0 or (temperature > 0 and draw[5] < np.exp(-cost / temperature)):
            search.groups[i] = group
            reward = then
            made += 1
        else:
            search.told[i] = told
            _recode(i, changed, old, collision, mass, search, edges, families, counts, num_values)
    return made
