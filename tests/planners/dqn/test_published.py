from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from domains.core import UNSEEN, load_domain
from planners.config import DQNConfig
from planners.dqn.published import DQNPerception, dqn_perception, occluded, relaxed_samples
from planners.perception import Perception
from tests.planners.dqn.test_dqn import SumCodec


def test_occlusion_is_the_task_s_own_rule() -> None:
    """The same poses in the two variants: what `clean` shows, seen through the rule, is what `occluded` shows."""
    domain = load_domain()
    parameters: dict[str, Any] = {"size": 13, "num_crossings": 3}
    through = domain.make("following", 64, variant="occluded", seed=4, see_through_walls=True, **parameters)
    hidden = domain.make("following", 64, variant="occluded", seed=4, **parameters)
    for env in (through, hidden):
        env.reset(seed=4)
    assert (hidden.person_views() == UNSEEN).any()
    np.testing.assert_array_equal(occluded(through.person_views()), hidden.person_views())


def test_relaxed_samples_are_distributions_that_choose_as_the_belief_says() -> None:
    belief = np.tile(np.array([0.7, 0.2, 0.1, 0.0], np.float32), (4000, 1, 1))
    samples = relaxed_samples(belief, 0.6, np.random.default_rng(0))
    np.testing.assert_allclose(samples.sum(axis=-1), 1.0, atol=1e-5)
    shares = np.bincount(samples.argmax(axis=-1).ravel(), minlength=4) / 4000
    np.testing.assert_allclose(shares, belief[0, 0], atol=0.03)
    certain = np.eye(4, dtype=np.float32)[None]
    np.testing.assert_array_equal(relaxed_samples(certain, 0.6, np.random.default_rng(0)), certain)


def test_fallbacks_where_the_person_is_out_of_view() -> None:
    codec: Any = SumCodec()
    rng = np.random.default_rng(0)
    observation = {"view": rng.integers(0, 2, (4, 5, 5)).astype(np.uint8), "configuration": np.array([0, 35, 0, 50])}
    person_views = rng.integers(0, 2, (4, 5, 5)).astype(np.uint8)
    base = DQNConfig()

    def shifted(influence: str, fallback: str) -> np.ndarray:
        config = replace(base, fallback=fallback)  # type: ignore[arg-type]
        return dqn_perception(codec, influence, np.random.default_rng(1), config)(observation, person_views).shifted

    true = codec.beliefs(person_views)
    np.testing.assert_array_equal(shifted("perfect-information", "mode"), true)
    uniform = shifted("perfect-information", "uniform")
    np.testing.assert_array_equal(uniform[[1, 3]], true[[1, 3]])
    assert (uniform[[0, 2]] == 1 / 8).all()
    assert (shifted("random", "uniform")[[0, 2]] == 1 / 8).all()
    assert (shifted("random", "mode").max(axis=-1) == 1.0).all()
    np.testing.assert_array_equal(shifted("perfect-information", "published"), true)
    assert isinstance(dqn_perception(codec, "zero", rng, base), Perception)
    assert not isinstance(dqn_perception(codec, "zero", rng, base), DQNPerception)
    sampled = dqn_perception(codec, "random", rng, replace(base, published_sampling=True))(observation, person_views)
    assert (sampled.shifted[[0, 2]] == 1 / 8).all()
