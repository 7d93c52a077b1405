"""How far rollouts of marginals drift from the model when steps are chained.

A belief kept as a product of marginals forgets after every step how the factors hang together (the projection of
Boyen and Koller 1998). One step from it is exact; a chain of steps is not, and is never presented as such.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nesy.dbn.inference.factored import FactoredUpdates
from nesy.dbn.inference.plans import step_codes
from nesy.dbn.model import TwoSliceDBN


def rollout_drift(
    dbn: TwoSliceDBN,
    codes: np.ndarray,
    rng: np.random.Generator,
    steps: int = 8,
    starts: int = 8,
    drop: float = 1e-6,
    least: float = 1e-4,
) -> dict[str, Any]:
    """Total variation between rollouts of marginals and exact ones, after 1, 2, ... steps of random plans.

    The exact distribution over whole codes is followed step by step. Branches less probable than `drop` are cut;
    `left_out` is what that costs, so the true figures lie between `low` and `high`.

    Args:
        dbn: the model.
        codes: uint8 [C, N], codes to start from.
        rng: draws starts and plans.
        steps: length of the plans.
        starts: plans.
        drop: see above; 0 cuts nothing.
        least: entries of the rolled belief below this are taken as 0 before the next step (dense tables are slow
            otherwise); 0 keeps all.

    Returns:
        `steps`; means over the plans: `joint_low`, `joint_high` of whole codes, `marginal_low`, `marginal_high` of
        single factors (their mean), `left_out`.
    """
    updates = FactoredUpdates(dbn)
    n, k = dbn.num_factors, dbn.num_values
    figures = np.zeros((starts, steps, 3))
    for plan in range(starts):
        start = codes[rng.integers(len(codes))].astype(np.int64)
        belief = np.eye(k)[start][None]
        now, weights = start[None], np.ones(1)
        for step in range(steps):
            action = int(rng.integers(dbn.num_actions))
            kept = np.where(belief >= least, belief, 0.0)
            belief = updates.predict(kept / kept.sum(axis=2, keepdims=True), np.array([action]))
            now, weights = step_codes(dbn, now, weights, action, range(n), drop=drop)
            product = belief[0][np.arange(n), now].prod(axis=1)
            exact = np.stack([np.bincount(now[:, i], weights, k) for i in range(n)])
            shared = np.minimum(exact, belief[0]).sum(axis=1).mean()
            figures[plan, step] = np.minimum(weights, product).sum(), shared, 1.0 - weights.sum()
    overlap, shared, left = np.maximum(figures, 0.0).mean(axis=0).T
    return {
        "steps": list(range(1, steps + 1)),
        "joint_low": np.maximum(0.0, 1.0 - overlap - left).tolist(),
        "joint_high": np.maximum(0.0, 1.0 - overlap).tolist(),
        "marginal_low": np.maximum(0.0, 1.0 - shared - left).tolist(),
        "marginal_high": np.maximum(0.0, 1.0 - shared).tolist(),
        "left_out": left.tolist(),
    }
