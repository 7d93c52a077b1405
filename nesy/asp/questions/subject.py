"""What questions are about: a 2DBN, its codebook, and their names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from nesy.asp.program.facts import Facts
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp.questions.planning import PredicateTruth


class Subject:
    """A model, with the views met in experience where a codebook is given."""

    def __init__(self, dbn: TwoSliceDBN, codebook: Codebook | None = None) -> None:
        """A knowledge base over a model, with the views met in experience where a codebook is given."""
        self.dbn, self.codebook = dbn, codebook
        self.facts = Facts(dbn, codebook)
        self._known_truth: PredicateTruth | None = None

    def factor(self, factor: int | str) -> int:
        """The number of a factor given by number or name.

        Raises:
            UserError: there is none such.
        """
        if isinstance(factor, str) and factor in self.dbn.factor_names:
            return self.dbn.factor_names.index(factor)
        if isinstance(factor, str) and re.fullmatch(r"\d+", factor):
            factor = int(factor)
        if isinstance(factor, int) and 0 <= factor < self.dbn.num_factors:
            return factor
        names = ", ".join(self.dbn.factor_names)
        raise UserError(f"no factor '{factor}'; the factors are 0 to {self.dbn.num_factors - 1} ({names})")

    def action(self, action: int | str) -> int:
        """The number of an action given by number or name.

        Raises:
            UserError: there is none such.
        """
        if isinstance(action, str) and action in self.dbn.action_names:
            return self.dbn.action_names.index(action)
        if isinstance(action, int) and 0 <= action < self.dbn.num_actions:
            return action
        raise UserError(f"no action '{action}'; the actions are {', '.join(self.dbn.action_names)}")

    @property
    def book(self) -> Codebook:
        """The codebook.

        Raises:
            UserError: this model has none.
        """
        if self.codebook is None or not len(self.codebook):
            raise UserError("this model has no codebook: its values have no meaning in views")
        return self.codebook

    def _truth(self) -> PredicateTruth:
        """What holds in the codes of the codebook, worked out once."""
        from nesy.asp.questions.planning import PredicateTruth

        if self._known_truth is None:
            self._known_truth = PredicateTruth(self.book)
        return self._known_truth

    def _truth_if_known(self) -> PredicateTruth | None:
        return None if self.codebook is None or not len(self.codebook) else self._truth()
