"""Exact inference against brute force over all codes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.dbn.inference import exact as inference
from nesy.dbn.inference.factored import FactoredUpdates
from nesy.dbn.inference.kernels import packed, sample_codes
from nesy.errors import UserError
from tests.nesy.dbn.models import all_codes, joint, marginals_of, random_dbn, transition_matrix

seeds = st.integers(0, 2**32 - 1)


def random_belief(rng, dbn):
    belief = rng.dirichlet(np.full(dbn.num_values, 0.5), size=dbn.num_factors)
    # some rows certain, some with values ruled out
    belief[0] = np.eye(dbn.num_values)[rng.integers(dbn.num_values)]
    belief[-1] = np.where(belief[-1] < 0.1, 0, belief[-1])
    return belief / belief.sum(axis=1, keepdims=True)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_predict_is_the_marginal_of_the_joint(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, zeros=seed % 2 == 0)
    belief = random_belief(rng, dbn)
    for action in range(dbn.num_actions):
        expected = marginals_of(joint(belief) @ transition_matrix(dbn, action), dbn)
        np.testing.assert_allclose(dbn.predict(belief, action), expected, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_filter_is_bayes_rule(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng)
    belief = random_belief(rng, dbn)
    likelihood = rng.random(belief.shape)
    likelihood[1] = 0.7  # says nothing
    posterior = (joint(belief) @ transition_matrix(dbn, 1)) * joint(likelihood)
    expected = marginals_of(posterior / posterior.sum(), dbn)
    np.testing.assert_allclose(dbn.filter(belief, 1, likelihood), expected, atol=1e-12)


def test_filter_falls_back_to_the_observation_when_it_is_impossible():
    rng = np.random.default_rng(3)
    dbn = random_dbn(rng, zeros=True, max_parents=1, concentration=0.1)
    code = np.zeros(3, dtype=int)
    impossible = np.argwhere(dbn.predict(np.eye(3)[code], 0) == 0)
    factor, value = impossible[0]
    likelihood = np.ones((3, 3))
    likelihood[factor] = np.eye(3)[value]
    likelihood[(factor + 1) % 3] = 0
    posterior = dbn.filter(np.eye(3)[code], 0, likelihood)
    np.testing.assert_allclose(posterior.sum(axis=1), 1)
    assert posterior[factor, value] == 1
    other = (factor + 1) % 3
    np.testing.assert_allclose(posterior[other], dbn.predict(np.eye(3)[code], 0)[other])


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_plan_marginals_chain_steps_exactly(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng)
    belief = random_belief(rng, dbn)
    plan = rng.integers(0, 2, size=3).tolist()
    distribution = joint(belief)
    for action in plan:
        distribution = distribution @ transition_matrix(dbn, action)
    expected = distribution.reshape((3,) * 3)
    result = inference.plan_marginals(dbn, belief, plan, (2, 0))
    np.testing.assert_allclose(result, expected.sum(axis=1).T, atol=1e-12)


def test_plan_marginals_with_evidence_on_the_way():
    rng = np.random.default_rng(5)
    dbn = random_dbn(rng)
    belief = random_belief(rng, dbn)
    distribution = joint(belief) @ transition_matrix(dbn, 0)
    distribution = distribution * (all_codes(dbn)[:, 1] == 2)
    expected = marginals_of(distribution @ transition_matrix(dbn, 1), dbn)[0]
    result = inference.plan_marginals(dbn, belief, [0, 1], (0,), evidence={(1, 1): 2})
    np.testing.assert_allclose(result, expected, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_joint_next_and_log_prob_agree_with_the_matrix(seed):
    rng = np.random.default_rng(seed)
    dbn = random_dbn(rng, zeros=True)
    codes = all_codes(dbn)
    matrix = transition_matrix(dbn, 0)
    start = int(rng.integers(len(codes)))
    later, weights = inference.joint_next(dbn, codes[start], 0)
    index = later.astype(int) @ [9, 3, 1]
    found = np.zeros(len(codes))
    found[index] = weights
    np.testing.assert_allclose(found, matrix[start], atol=1e-12)
    assert (np.diff(weights) <= 0).all()
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(dbn.log_prob(codes[start], 0, codes), np.log(matrix[start]), atol=1e-9)


def test_samples_have_the_model_s_frequencies_and_do_not_depend_on_the_kernel():
    rng = np.random.default_rng(1)
    dbn = random_dbn(rng)
    codes = np.tile(np.array([1, 2, 0], dtype=np.uint8), (20_000, 1))
    actions = np.ones(len(codes), dtype=np.int64)
    drawn = dbn.sample(codes, actions, np.random.default_rng(7))
    uniforms = np.random.default_rng(7).random(codes.shape)
    np.testing.assert_array_equal(sample_codes(packed(dbn), codes, actions, uniforms), drawn)
    frequencies = np.bincount(drawn.astype(int) @ [9, 3, 1], minlength=27) / len(codes)
    row = transition_matrix(dbn, 1)[1 * 9 + 2 * 3]
    assert np.abs(frequencies - row).max() < 5 * np.sqrt(0.25 / len(codes))


def test_most_probable_next_of_a_deterministic_model_is_its_only_next():
    rng = np.random.default_rng(2)
    dbn = random_dbn(rng, concentration=1e-3)
    codes = all_codes(dbn)
    later, weights = inference.most_probable_next(dbn, codes, 0)
    np.testing.assert_allclose(np.log(weights), dbn.log_prob(codes, 0, later), atol=1e-9)


def test_wrong_arguments_are_named():
    dbn = random_dbn(np.random.default_rng(0))
    with pytest.raises(UserError, match="shape"):
        dbn.predict(np.ones((2, 3)) / 3, 0)
    with pytest.raises(UserError, match="distribution"):
        dbn.predict(np.ones((3, 3)), 0)
    with pytest.raises(UserError, match="action"):
        dbn.predict(np.ones((3, 3)) / 3, 2)
    with pytest.raises(UserError, match="values"):
        dbn.log_prob(np.array([0, 0, 3]), 0, np.array([0, 0, 0]))


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_batched_prediction_is_the_exact_one(seed):
    rng = np.random.default_rng(seed)
    # values are added up in blocks of eight and four, and one by one
    k, n = ((3, 5), (5, 4), (9, 3))[seed % 3]
    dbn = random_dbn(rng, num_factors=n, num_values=k, max_parents=3 if k == 3 else 2, zeros=k == 3)
    # certain, spread, and in between; more than one block of the same action
    beliefs = np.stack([random_belief(rng, dbn) for _ in range(6)])
    beliefs[1] = np.eye(k)[rng.integers(0, k, size=n)]
    beliefs = beliefs[rng.integers(0, 6, size=80)]
    actions = rng.integers(0, 2, size=80)
    expected = [dbn.predict(belief, action) for belief, action in zip(beliefs, actions, strict=True)]
    np.testing.assert_allclose(FactoredUpdates(dbn).predict(beliefs, actions), expected, atol=1e-12)


def test_batched_filter_agrees_with_the_exact_one_on_independent_factors_and_has_the_same_fallback():
    rng = np.random.default_rng(4)
    dbn = random_dbn(rng, arcs=False, zeros=True, concentration=0.2)
    codes = all_codes(dbn)
    beliefs, actions = np.eye(3)[codes], rng.integers(0, 2, size=len(codes))
    likelihoods = rng.random(beliefs.shape)
    filtered = FactoredUpdates(dbn).filter(beliefs, actions, likelihoods)
    expected = [dbn.filter(b, a, o) for b, a, o in zip(beliefs, actions, likelihoods, strict=True)]
    np.testing.assert_allclose(filtered, expected, atol=1e-12)
    predicted = FactoredUpdates(dbn).predict(beliefs, actions)
    b, i, k = np.argwhere(predicted == 0)[0]
    likelihoods[b, i] = np.eye(3)[k]
    likelihoods[b, (i + 1) % 3] = 0
    fallen = FactoredUpdates(dbn).filter(beliefs, actions, likelihoods)
    np.testing.assert_allclose(fallen[b, i], np.eye(3)[k])
    np.testing.assert_allclose(fallen[b, (i + 1) % 3], predicted[b, (i + 1) % 3])


def test_actions_may_be_named():
    dbn = random_dbn(np.random.default_rng(4))
    belief = np.full((dbn.num_factors, dbn.num_values), 1.0 / dbn.num_values)
    code = np.zeros(dbn.num_factors, dtype=np.int64)
    for a, name in enumerate(dbn.action_names):
        assert np.array_equal(dbn.predict(belief, name), dbn.predict(belief, a))
        assert np.array_equal(dbn.filter(belief, name, belief), dbn.filter(belief, a, belief))
        assert dbn.log_prob(code, name, code) == dbn.log_prob(code, a, code)
        assert np.array_equal(
            dbn.sample(code, name, np.random.default_rng(0)), dbn.sample(code, a, np.random.default_rng(0))
        )
    for action in ("fly", -1, 1.5, [0, 1]):
        with pytest.raises(UserError, match="action"):
            dbn.predict(belief, action)
