"""Learning of the belief DQN: environment steps and updates, beside a plain loop over a single environment.

Input set `paper`, influence mode `perspective-shift`. The plain loop takes one step of one environment at a time and
encodes and shifts anew at every step, and its learner is the paper's: one update of 500-500 units per step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.cli.benches.measuring import Row, Settings, ranked, rate

if TYPE_CHECKING:
    from planners.config import DQNConfig
    from planners.dqn.dqn import Training

NEEDS = ("train",)


def measure(settings: Settings) -> list[Row]:
    """Rates of acting alone, of updates alone, and of learning as a whole."""
    import torch

    from domains.core import load_domain
    from nesy.cli import configuration
    from nesy.world_model import SymbolicCodec, load_world_model
    from planners.config import DQNConfig
    from planners.dqn.dqn import Training
    from planners.perception import Perception

    torch.set_num_threads(1)
    config = configuration.load(settings.run.config)
    domain, model = load_domain(config.domain), load_world_model(settings.run.world_model)

    def training(learner: DQNConfig) -> Training:
        endless = replace(learner, episodes=10**9)
        codec = SymbolicCodec(model)
        return Training(domain, codec, "paper", "perspective-shift", config.variant, endless, settings.seed)

    def forgetting(learner: Training) -> Callable[[], None]:
        def forget() -> None:
            learner.perception = Perception(SymbolicCodec(model), "perspective-shift", np.random.default_rng(0))

        return forget

    fast, plain = training(DQNConfig.fast()), training(DQNConfig.paper())
    batched, single = f"{fast.config.num_envs} environments at once, preset fast", "one environment, paper's preset"
    forget = forgetting(plain)

    def timed(work: Callable[[], int]) -> float:
        return rate(work, settings.seconds, warm_up=30)

    acting = {single: timed(lambda: _act(plain, forget)), batched: timed(lambda: _act(fast))}
    learning = {single: timed(lambda: _learn(plain, forget)), batched: timed(lambda: _learn(fast))}
    updates = {single: timed(lambda: _update(plain)), batched: timed(lambda: _update(fast))}
    rows: list[Row] = []
    for what, unit, rates in (
        ("acting", "steps/s", acting),
        ("learning", "steps/s", learning),
        ("updates alone", "updates/s", updates),
    ):
        rows += ranked(unit, f"{what}: {single}", {f"{what}: {name}": figure for name, figure in rates.items()})
    return rows


def _act(learner: Training, before: Callable[[], Any] = lambda: None) -> int:
    before()
    learner.step(learner.choose())
    return learner.config.num_envs


def _learn(learner: Training, before: Callable[[], Any] = lambda: None) -> int:
    steps = _act(learner, before)
    learner.steps = max(learner.steps, learner.config.warm_up)  # measured from the first update on
    learner.learn()
    return steps


def _update(learner: Training) -> int:
    learner.update()
    return 1
