"""The measures of Φ, on situations small enough to count by hand."""

import numpy as np
import pytest

from domains.core import ViewGeometry
from nesy.log.experience import Experience
from nesy.perspective.gates import evaluate_shift, situations_met
from nesy.perspective.operator import PerspectiveShift
from nesy.world_model import SymbolicCodec

AHEAD = int(ViewGeometry().encode(2, 3, 3))


def test_situations_are_counted() -> None:
    views = np.zeros((5, 5, 5), dtype=np.uint8)
    views[3:, 0, 0] = 1
    true = np.zeros_like(views)
    true[1, 4, 4] = 1
    cases = situations_met(views, np.array([7, 7, 7, 7, 0]), true)
    assert cases is not None
    assert cases.weight.sum() == 4
    assert len(cases.own) == 2
    np.testing.assert_array_equal(cases.configuration, 7)
    first = cases.pair == np.flatnonzero((cases.own == 0).all((1, 2)))[0]
    assert sorted(cases.weight[first].tolist()) == [1, 2]
    assert situations_met(views, np.zeros(5, dtype=np.int64), true) is None


def test_the_best_possible_bounds_the_shift(codec: SymbolicCodec, toy: Experience) -> None:
    rows = np.flatnonzero((toy.action == 2) & (toy.view[:, 2, 3] == 0))
    cases = situations_met(toy.view[rows], np.full(len(rows), AHEAD), toy.next_view[rows])
    assert cases is not None
    figures = evaluate_shift(codec, cases, PerspectiveShift(codec))
    assert figures["reachable"] == 1.0
    assert list(figures["by_steps"]) == list(figures["by_distance"]) == ["1"]
    assert figures["by_steps"]["1"]["share"] == 1.0
    assert figures["by_steps"]["1"]["shift"]["exact"] == pytest.approx(figures["shift"]["exact"])
    assert figures["best"]["exact"] >= figures["shift"]["exact"] > figures["random"]["exact"]
    assert figures["shift"]["cells_seen"] >= 0.99
    assert figures["best"]["kl"] <= figures["shift"]["kl"] + 1e-6
    assert figures["random"]["kl"] == pytest.approx(codec.num_factors * np.log(codec.num_values), rel=1e-3)
    assert "best" not in evaluate_shift(codec, cases, PerspectiveShift(codec), bound=False)
