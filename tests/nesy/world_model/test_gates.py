"""The gates, checked by hand on tiny cases."""

import numpy as np
import pytest

from nesy.world_model import SymbolicCodec
from nesy.world_model.distinct import Transitions, transitions_of, unobstructed, view_keys
from nesy.world_model.training.gates import evaluate, limits, view_gates


def test_limits_by_hand() -> None:
    views = np.zeros((3, 5, 5), dtype=np.uint8)
    views[1, 0, 0], views[2, 0, :2] = 1, 1
    transitions = Transitions(
        views=views, visits=np.ones(3, int), source=np.array([0, 0, 1]), action=np.array([2, 2, 2]),
        target=np.array([1, 2, 1]), weight=np.array([3, 1, 4]), num_actions=3,
    )  # fmt: skip
    found = limits(transitions)
    entropy = -(3 * np.log(3 / 4) + np.log(1 / 4)) / 8
    assert found["next_code_nll"] == pytest.approx(entropy)
    assert found["next_view_exact"] == pytest.approx(7 / 8)
    assert found["next_view_cells"] == pytest.approx((7 + 24 / 25) / 8)
    assert found["inverse_accuracy"] == pytest.approx(1.0)


def test_view_keys_tell_views_apart() -> None:
    views = np.random.default_rng(0).integers(0, 4, (300, 5, 5)).astype(np.uint8)
    assert len(np.unique(view_keys(views))) == len(np.unique(views.reshape(300, -1), axis=0))
    wide = np.random.default_rng(0).integers(0, 2, (300, 7, 7)).astype(np.uint8)
    wide[:150] = wide[150:]
    assert len(np.unique(view_keys(wide))) == 150


def test_transitions_count_visits(toy) -> None:  # type: ignore[no-untyped-def]
    transitions = transitions_of(toy)
    assert transitions.weight.sum() == len(toy) and transitions.visits.sum() == 2 * len(toy)
    keys = view_keys(transitions.views)
    met: dict[tuple[int, int, int], int] = {}
    for row in zip(view_keys(toy.view), toy.action, view_keys(toy.next_view), strict=True):
        met[row] = met.get(row, 0) + 1
    edges = zip(keys[transitions.source], transitions.action, keys[transitions.target], strict=True)
    assert dict(zip(edges, transitions.weight.tolist(), strict=True)) == met


def test_transitions_count_maps_where_that_is_asked_for(toy) -> None:  # type: ignore[no-untyped-def]
    transitions = transitions_of(toy, weighting="maps")
    assert transitions.visits.sum() == 2 * len(toy)
    assert transitions.weight.max() <= len(np.unique(toy.map_id))
    met = set()
    keys, next_keys = view_keys(toy.view), view_keys(toy.next_view)
    for row in range(len(toy)):
        met.add((int(toy.map_id[row]), int(keys[row]), int(toy.action[row]), int(next_keys[row])))
    assert transitions.weight.sum() == len(met)


def test_another_agent_in_the_way_is_left_out(toy) -> None:  # type: ignore[no-untyped-def]
    import dataclasses

    configuration = np.zeros(len(toy), dtype=np.int16)
    configuration[0] = 1 + (2 * 5 + 3) * 4 + 1  # in the cell ahead
    configuration[1] = 1 + (2 * 5 + 2) * 4  # two cells ahead
    blocked = dataclasses.replace(toy, configuration=configuration)
    assert np.flatnonzero(~unobstructed(blocked)).tolist() == [0]


def test_a_trained_toy_model_passes(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    transitions = transitions_of(toy)
    figures = evaluate(codec, transitions)
    assert figures["views_exact"] == 1.0
    assert figures["distinct_codes"] == figures["distinct_views"] == transitions.num_views
    assert figures["next_code_nll"] >= figures["limits"]["next_code_nll"] - 1e-9
    assert figures["next_view_exact"] <= figures["limits"]["next_view_exact"] + 1e-9
    assert all(figures["passed"].values()), figures


def test_views_that_share_a_code_are_counted(codec: SymbolicCodec, toy) -> None:  # type: ignore[no-untyped-def]
    class Collapsed:
        num_factors, num_values = codec.num_factors, codec.num_values

        def codes(self, views: np.ndarray) -> np.ndarray:
            return np.zeros((len(views), 8), dtype=np.uint8)

        def views(self, codes: np.ndarray) -> np.ndarray:
            return np.repeat(toy.view[:1], len(codes), 0)

    views = transitions_of(toy).views
    figures = view_gates(Collapsed(), views)  # type: ignore[arg-type]
    assert figures["distinct_codes"] == 1
    assert figures["views_exact"] == pytest.approx(1 / len(views))
    assert figures["values_used"] == [1] * 8
    assert figures["perplexity"] == pytest.approx([1.0] * 8)
