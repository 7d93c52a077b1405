"""The particle filter against exact filtering."""

import numpy as np
import pytest

from nesy.dbn.inference.particles import ParticleFilter
from nesy.errors import UserError
from tests.nesy.dbn.models import all_codes, marginals_of, random_dbn, transition_matrix


def test_it_converges_to_the_exact_filter_over_several_steps():
    rng = np.random.default_rng(0)
    dbn = random_dbn(rng)
    codes = all_codes(dbn)
    exact = np.full(27, 1 / 27)
    filter_ = ParticleFilter(dbn)
    belief = filter_.start(np.repeat(codes, 2000, axis=0))
    for _ in range(4):
        action, likelihood = int(rng.integers(2)), rng.random((3, 3)) ** 3
        exact = (exact @ transition_matrix(dbn, action)) * likelihood[np.arange(3), codes].prod(axis=1)
        exact /= exact.sum()
        belief = filter_.update(belief, action, likelihood, rng)
        assert not belief.depleted
        np.testing.assert_allclose(belief.marginals(3), marginals_of(exact, dbn), atol=0.02)
        assert belief.weights.sum() == pytest.approx(1)
        assert belief.effective > 0.4 * len(belief.codes)


def test_an_observation_that_no_particle_explains():
    rng = np.random.default_rng(1)
    dbn = random_dbn(rng)
    filter_ = ParticleFilter(dbn)
    belief = filter_.start(np.zeros((100, 3), dtype=int))
    proposed = filter_.update(belief, 0, lambda codes: np.zeros(len(codes)), rng, lambda n, rng: np.ones((n, 3), int))
    assert proposed.depleted and (proposed.codes == 1).all()
    stays = filter_.update(belief, 0, lambda codes: np.zeros(len(codes)), rng)
    assert stays.depleted and len(stays.codes) == 100 and stays.weights.sum() == pytest.approx(1)
    # factor 0 is observed as 2; what is said about the others together is impossible
    likelihood = np.ones((3, 3))
    likelihood[0] = [0, 0, 1]
    likelihood[1] = 0
    narrowed = filter_.update(belief, 0, likelihood, rng)
    assert narrowed.depleted
    if (narrowed.codes[:, 0] == 2).any():
        assert narrowed.marginals(3)[0, 2] == pytest.approx(1)


def test_the_same_seed_gives_the_same_particles():
    dbn = random_dbn(np.random.default_rng(2))
    filter_ = ParticleFilter(dbn)
    belief = filter_.start(all_codes(dbn))
    likelihood = np.random.default_rng(3).random((3, 3)) ** 4
    first, second = (filter_.update(belief, 0, likelihood, np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(first.codes, second.codes)
    np.testing.assert_array_equal(first.weights, second.weights)


def test_wrong_arguments():
    dbn = random_dbn(np.random.default_rng(2))
    filter_ = ParticleFilter(dbn)
    with pytest.raises(UserError, match="at least one"):
        filter_.start(np.zeros((0, 3), dtype=int))
    belief = filter_.start(np.zeros((2, 3), dtype=int))
    rng = np.random.default_rng(0)
    with pytest.raises(UserError, match="shape"):
        filter_.update(belief, 0, np.ones((2, 3)), rng)
    with pytest.raises(UserError, match=">= 0"):
        filter_.update(belief, 0, -np.ones((3, 3)), rng)
