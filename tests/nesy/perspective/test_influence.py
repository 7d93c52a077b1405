"""The influence prior: what its modes mean, in one place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nesy.errors import UserError
from nesy.perspective.influence import INFLUENCE_MODES, InfluencePrior, influence

WEIGHTS = arrays(np.float64, st.integers(1, 6), elements=st.floats(0.0, 5.0)).filter(lambda w: w.sum() > 0.1)


@given(WEIGHTS, st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_random_is_one_draw_of_what_zero_has(weights: np.ndarray, seed: int) -> None:
    zero, random = (InfluencePrior(mode, np.random.default_rng(seed)) for mode in ("zero", "random"))
    np.testing.assert_allclose(zero.base(weights), weights / weights.sum())
    for _ in range(5):
        random.renew()
        drawn = random.base(weights)
        assert sorted(drawn.tolist())[-1] == 1.0 and drawn.sum() == 1.0
        assert weights[drawn.argmax()] > 0
        np.testing.assert_array_equal(drawn, random.base(weights))  # the same throughout a decision


def test_random_draws_are_as_frequent_as_zero_says() -> None:
    prior, weights = InfluencePrior("random", np.random.default_rng(0)), np.array([1.0, 0.0, 3.0])
    total = np.zeros(3)
    for _ in range(4000):
        prior.renew()
        total += prior.base(weights)
    assert total / 4000 == pytest.approx([0.25, 0.0, 0.75], abs=0.03)


def test_codes() -> None:
    assert (InfluencePrior("zero", np.random.default_rng(0)).codes((3, 2), 4) == 0.25).all()
    drawn = InfluencePrior("random", np.random.default_rng(0)).codes((300, 2), 4)
    assert set(np.unique(drawn)) == {0.0, 1.0} and (drawn.sum(-1) == 1).all()
    assert drawn.mean(axis=(0, 1)) == pytest.approx(0.25, abs=0.06)


@given(WEIGHTS, st.data())
@settings(max_examples=50, deadline=None)
def test_the_influence_is_a_mixture(believed: np.ndarray, data: st.DataObject) -> None:
    policy = data.draw(arrays(np.float64, (len(believed), 3), elements=st.floats(0.01, 1.0)))
    policy /= policy.sum(axis=1, keepdims=True)
    found = influence(policy, believed)
    by_hand = sum(b * row for b, row in zip(believed / believed.sum(), policy, strict=True))
    np.testing.assert_allclose(found, by_hand, atol=1e-12)
    assert found.sum() == pytest.approx(1.0)


def test_modes() -> None:
    blind = {mode for mode in INFLUENCE_MODES if InfluencePrior(mode, np.random.default_rng(0)).blind}
    assert blind == {"zero", "random"}
    with pytest.raises(UserError, match="unknown influence mode 'telepathy'"):
        InfluencePrior("telepathy", np.random.default_rng(0))
