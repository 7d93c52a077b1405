"""The rows behind a step."""

import numpy as np
import pytest

from nesy.asp import KnowledgeBase
from nesy.asp.questions.explanation import explain_step
from nesy.errors import UserError
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.toy import toy


def test_a_step_is_explained_by_its_rows():
    base = KnowledgeBase(*toy())
    found = base.explain([0, 1, 1], "go")
    assert found.next_code == (0, 0, 1) and found.probability == 1
    side = next(s for s in found.supports if s.factor == "side")
    assert side.parents == (("side", 1), ("front", 0)) and side.count == 2
    assert "changes: side' = 0 (probability 1) because of side = 1, front = 0 (met 2 times)" in found.text
    graph = found.graph()
    assert set(graph.predecessors("side' = 0")) == {"side = 1", "front = 0"}
    assert set(graph.predecessors("goal' = 1")) == {"goal = 1", "front' = 0"}


def test_rows_never_met_are_called_guesses():
    text = KnowledgeBase(*toy()).explain([2, 2, 2], "go").text
    assert "never met: a guess" in text


def test_the_probability_is_that_of_the_model_and_open_factors_take_their_likeliest_value():
    rng = np.random.default_rng(0)
    for _ in range(20):
        dbn = random_dbn(rng)
        code, later = rng.integers(0, 3, size=3), rng.integers(0, 3, size=3)
        found = explain_step(dbn, code, 1, later)
        assert found.probability == pytest.approx(np.exp(dbn.log_prob(code, 1, later)))
        open_ = later.copy()
        open_[dbn.order[-1]] = -1
        best = max(np.exp(dbn.log_prob(code, 1, np.where(np.arange(3) == dbn.order[-1], v, later))) for v in range(3))
        assert explain_step(dbn, code, 1, open_).probability == pytest.approx(best)


def test_counterexamples_come_with_their_rows():
    text = KnowledgeBase(*toy()).verify("swap", "front=1", "same").text
    assert "because of side =" in text


def test_codes_of_another_model_are_refused():
    with pytest.raises(UserError):
        KnowledgeBase(*toy()).explain([0, 1], "go")
