"""The code book of few distinct views: named factors first, then factors that complete the code.

1. `questions`: every factor gets a group of questions (`questions.py`).
2. `codes`: the last `named` factors keep their questions; the others, which come first in the order of slice t+1,
   give up theirs. Their values are refined entry by entry until codes are distinct and predict the next code
   (`refinement.py`); a value still costs what it fails to tell about the questions that its factor knows best.

Without named factors the second step starts from random codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nesy.world_model.codes.questions import GroupSearch, Questions
from nesy.world_model.codes.refinement import CodeBook, Refiner, separate
from nesy.world_model.codes.telling import telling_cost
from nesy.world_model.structure import Structure

MOVES, SWEEPS = 1500, 2
"""Moves tried in a round of questions; passes over the code book in a round of refinement."""
HOT, COLD = 0.02, 0.001
"""Temperatures of the questions in their first and their last but one round, nats per transition; then 0."""
WARM, NEVER = 0.001, 1e3
"""Temperature of the questions at the start of the second step, and what makes codes stay distinct there."""
QUIET = 0.8
"""Share of the rounds of the second step after which there is no noise."""


@dataclass(frozen=True)
class SearchSettings:
    """What the search is made of; scripts/ablations.py leaves out one at a time."""

    noise: float = 12.0
    """Annealing temperature of the refinement at its start, in nats."""
    collision: float = 1.0
    """Price in the first step of a nat that codes do not say about the view; completing factors add it later."""
    adjusting: int = 300
    """Moves of the questions in a round of the second step."""
    meaning: float = 1.0
    """Nats of cost per nat that a value of a completing factor fails to tell about a view."""
    told: float = 0.005
    """Bonus of a question that one factor answers: nats per transition for each nat of its entropy over the views."""


class CodeSearch:
    """Both steps, round by round; all state goes through `state` and `restore`."""

    def __init__(
        self,
        refiner: Refiner,
        questions: Questions,
        num_factors: int,
        named: int,
        headline: tuple[str, ...],
        settings: SearchSettings | None = None,
    ) -> None:
        """Prepare the search.

        Args:
            refiner: of the transitions to predict.
            questions: that can be asked.
            num_factors: N.
            named: how many factors keep their questions.
            headline: questions that the first named factor asks in any case.
            settings: of the search.
        """
        self.settings = settings or SearchSettings()
        self.refiner, self.questions, self.num_factors = refiner, questions, num_factors
        self.named = named if questions.names else 0
        self.completing = list(range(num_factors - self.named))
        self.asking = list(range(num_factors - self.named, num_factors))
        fixed = {num_factors - self.named: headline} if self.named else {}
        self._search = GroupSearch(questions, refiner, fixed, self.settings.told)
        self.groups: np.ndarray | None = None
        self.book: CodeBook | None = None
        self._kept: tuple[np.ndarray | None, CodeBook] | None = None

    def start(self, rng: np.random.Generator) -> None:
        """Begin: with random questions, or with random codes where no factor is to be named."""
        if self.named:
            self.groups, self.book = self._search.start(self.num_factors, rng)
        else:
            shape = (self.refiner.transitions.num_views, self.num_factors, self.refiner.num_values)
            self.book = self.refiner.search(separate(rng.normal(size=shape)))

    def questions_round(self, done: float, rng: np.random.Generator) -> dict[str, Any]:
        """One round of the first step; `done` is 1 in the last one."""
        assert self.groups is not None and self.book is not None
        temperature = HOT * (COLD / HOT) ** done if done < 1 else 0.0
        everyone = list(range(self.num_factors))
        self.groups, self.book, made = self._search.improve(
            self.groups, self.book, everyone, MOVES, temperature, self.settings.collision, rng
        )
        distinct = len(np.unique(self.book.codes, axis=0))
        return {"counted_nll": self.book.nll, "distinct_codes": distinct, "moved": made}

    def separate(self) -> None:
        """End of the first step: make the codes distinct, by the completing factors as far as they can."""
        assert self.book is not None
        num_values = self.refiner.num_values
        price = np.where(np.arange(self.num_factors) < len(self.completing), 1.0, 1e3)
        codes = separate((self.book.codes[:, :, None] == np.arange(num_values)) * price[:, None])
        self.book = self.refiner.search(codes, self.book.structure)

    def codes_round(self, done: float, rng: np.random.Generator) -> dict[str, Any]:
        """One round of the second step; the noise ends at 80 % of the rounds."""
        assert self.book is not None
        settings, loud = self.settings, max(0.0, 1.0 - done / QUIET)
        noise, codes = settings.noise * loud, self.book.codes
        cost = settings.meaning * telling_cost(self.questions.answers, codes, self.completing, self.refiner.num_values)
        self.book, moved = self.refiner.refine(self.book, cost, noise, SWEEPS, rng, self.completing)
        if self.groups is not None and settings.adjusting:
            temperature = WARM * loud
            self.groups, self.book, adjusted = self._search.improve(
                self.groups, self.book, self.asking, settings.adjusting, temperature, NEVER, rng
            )
            moved += adjusted
        return {"counted_nll": self.book.nll, "moved": moved, "noise": noise}

    def keep(self) -> None:
        """Remember the best of the code books that searches have ended with, this one included."""
        assert self.book is not None
        if self._kept is None or self.book.nll < self._kept[1].nll:
            self._kept = self.groups, self.book
        self.groups, self.book = self._kept

    def again(self) -> None:
        """Begin another search; what `keep` remembers stays."""
        self.groups, self.book = None, None

    def search(self, questions_rounds: int, codes_rounds: int, rng: np.random.Generator) -> CodeBook:
        """Both steps after `start`, all rounds."""
        for done in np.linspace(0.0, 1.0, questions_rounds) if self.named else ():
            self.questions_round(float(done), rng)
        self.separate()
        for epoch in range(codes_rounds):
            self.codes_round(epoch / codes_rounds, rng)
        assert self.book is not None
        return self.book

    def meanings(self) -> dict[str, Any]:
        """The named factors, by number: their questions and what every value answers."""
        if self.groups is None or self.book is None:
            return {}
        return {str(i): self.questions.meanings(self.groups[i], self.book.codes[:, i]) for i in self.asking}

    # ---------------------------------------------------------------- state
    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that the next round depends on."""
        tensors: dict[str, Tensor] = {}
        value: dict[str, Any] = {}
        for name, found in {"": (self.groups, self.book), "kept_": self._kept or (None, None)}.items():
            groups, book = found
            if book is not None:
                tensors[f"{name}codes"] = torch.as_tensor(book.codes)
                value[f"{name}book"] = {"nll": book.nll, **structure_value(book.structure)}
            if groups is not None:
                tensors[f"{name}groups"] = torch.as_tensor(groups)
        return tensors, value

    def restore(self, tensors: dict[str, Tensor], value: dict[str, Any]) -> None:
        """Continue from what `state` gave."""
        self.groups, self.book = _book_of("", tensors, value)
        groups, book = _book_of("kept_", tensors, value)
        self._kept = None if book is None else (groups, book)


def _book_of(name: str, tensors: dict[str, Tensor], value: dict[str, Any]) -> tuple[np.ndarray | None, CodeBook | None]:
    if f"{name}book" not in value:
        return None, None
    book = value[f"{name}book"]
    groups = tensors[f"{name}groups"].numpy().copy() if f"{name}groups" in tensors else None
    return groups, CodeBook(tensors[f"{name}codes"].numpy().copy(), structure_of(book), book["nll"])


def structure_value(structure: Structure) -> dict[str, Any]:
    """A structure as JSON values."""
    return {
        "parents_now": structure.parents_now,
        "parents_next": structure.parents_next,
        "order": structure.order,
    }


def structure_of(value: dict[str, Any]) -> Structure:
    """A structure from its JSON values."""

    def parents(name: str) -> tuple[tuple[tuple[int, ...], ...], ...]:
        return tuple(tuple(tuple(int(j) for j in family) for family in action) for action in value[name])

    return Structure(parents("parents_now"), parents("parents_next"), tuple(int(i) for i in value["order"]))
