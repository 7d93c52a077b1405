"""The agents that plan in the influence-augmented local model: particles of it, and a search or QMDP over them."""

from __future__ import annotations

import numpy as np

from domains.core import ViewGeometry
from planners.agents import BeliefAgent, Planner, Situation
from planners.config import SearchConfig
from planners.person_following.beliefs import ParticleBelief
from planners.person_following.ialm import IALM
from planners.person_following.kernels import compile_model

ALGORITHMS = {"pomdp": "POUCT of pomdp-py", "search": "PO-UCT", "qmdp": "QMDP"}


class PlanningAgent(BeliefAgent):
    """Keeps particles of the local model and plans with pomdp-py's POUCT, QMDP or our own search."""

    model = "2DBN + I(u|l)"

    def __init__(
        self,
        kind: str,
        model: IALM,
        config: SearchConfig,
        geometry: ViewGeometry,
        seed: int,
        influence: str = "perspective-shift",
    ) -> None:
        super().__init__(geometry, seed)
        self.kind, self.local_model, self.config, self.influence = kind, model, config, influence
        self.algorithm = ALGORITHMS[kind]
        self.compiled = compile_model(model)

    def _told(self, situation: Situation) -> np.ndarray:
        assert situation.percepts is not None
        return situation.percepts.shifted

    def _belief(self, rng: np.random.Generator) -> ParticleBelief:
        return ParticleBelief(self.local_model, self.compiled, self.config.particles, rng, mode=self.influence)

    def _planner(self, rng: np.random.Generator) -> Planner:
        if self.kind == "pomdp":
            from planners.person_following.pomdp_py_adapter import POUCTAgent

            return POUCTAgent(self.local_model, self.compiled, self.config, rng)
        if self.kind == "qmdp":
            from planners.person_following.qmdp import LocalQMDP

            return LocalQMDP(self.local_model, self.compiled, self.config, rng)
        from planners.person_following.ialm_search import IALMSearch

        return IALMSearch(self.local_model, self.compiled, self.config, rng)
