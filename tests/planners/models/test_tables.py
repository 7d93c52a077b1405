from __future__ import annotations

import numpy as np
import pytest

from planners.models.tables import Parents, learn_distribution, learn_mean, locate, pack

PARENTS = Parents(("a", "b", "c"), (0, 1, 2), (False, True, False))


def _random(n: int = 3000) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 5, (n, 3)).astype(np.int32)


def test_finds_the_contexts_that_matter_and_keeps_counts() -> None:
    variables = _random()
    target = ((variables[:, 0] == 2) & (variables[:, 1] <= 3)).astype(np.int64)
    table = learn_distribution(variables, PARENTS, target, 2)
    assert table.parents() == ("a", "b")
    assert table.rows == 3
    assert (table.estimates()[table.locate(variables)].argmax(axis=1) == target).all()
    leaves = table.slot < 0
    assert table.moments[leaves].sum() == len(variables)


def test_keeps_a_context_that_only_two_questions_together_tell_apart() -> None:
    variables = _random()
    target = ((variables[:, 0] == 1) ^ (variables[:, 2] == 1)).astype(np.int64)
    table = learn_distribution(variables, PARENTS, target, 2)
    assert (table.estimates()[table.locate(variables)].argmax(axis=1) == target).all()


def test_cuts_noise_off() -> None:
    rng = np.random.default_rng(1)
    variables = _random(400)
    table = learn_distribution(variables, PARENTS, rng.integers(0, 2, 400), 2)
    assert table.rows < 40


def test_weights_count_as_repetitions() -> None:
    variables = _random(50)
    target = (variables[:, 0] > 2).astype(np.int64)
    repeated = learn_distribution(np.repeat(variables, 3, axis=0), PARENTS, np.repeat(target, 3), 2)
    weighted = learn_distribution(variables, PARENTS, target, 2, np.full(50, 3.0))
    assert np.array_equal(repeated.moments, weighted.moments)


def test_mean() -> None:
    variables = _random()
    target = variables[:, 0] * 1.5 + (variables[:, 1] <= 1)
    table = learn_mean(variables, PARENTS, target)
    assert np.allclose(table.estimates()[table.locate(variables)][:, 0], target, atol=1e-6)


def test_estimates_are_smoothed_distributions() -> None:
    variables = _random()
    table = learn_distribution(variables, PARENTS, (variables[:, 0] == 0).astype(np.int64), 3)
    estimates = table.estimates()
    assert np.allclose(estimates.sum(axis=1), 1.0)
    assert (estimates > 0).all()


def test_packed_tables_answer_like_their_originals() -> None:
    variables = _random(200)
    first = learn_distribution(variables, PARENTS, (variables[:, 0] == 3).astype(np.int64), 2)
    second = learn_mean(variables, PARENTS, variables[:, 2])
    packed = pack([first, second])
    for row in variables[:20]:
        i, j = first.locate(row[None])[0], second.locate(row[None])[0]
        assert np.isclose(packed.estimate[locate(packed, 0, row), 0], first.estimates()[i, 0])
        assert np.isclose(packed.estimate[locate(packed, 1, row), 0], second.estimates()[j, 0])


def test_refuses_what_it_cannot_learn_from() -> None:
    with pytest.raises(ValueError, match="at least one example"):
        learn_distribution(np.zeros((0, 3), np.int32), PARENTS, np.zeros(0, np.int64), 2)
    with pytest.raises(ValueError, match="non-negative"):
        learn_distribution(np.full((2, 3), -1, np.int32), PARENTS, np.zeros(2, np.int64), 2)
