"""Online tree search in the influence-augmented local model (PO-UCT with leaf values from the model).

The tree branches on what matters for influence and reward: the person's pose if in view (else that it is not),
and whether the robot's own move succeeded. The 8^8 codes are sampled along, but not branched on; so the tree
goes deep with few simulations, at the price of plans that do not depend on what the robot will see of the walls.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from nesy.errors import UserError
from planners.config import SearchConfig
from planners.person_following.ialm import IALM
from planners.person_following.kernels import Model
from planners.person_following.local_walk import LocalModel
from planners.search.drawing import drawing_of
from planners.search.random_bits import stream
from planners.search.tree import allocate, clear
from planners.search.tree_top import in_words
from planners.search.walk import best_tried, walks


class IALMSearch:
    """Plans in a particle belief over the IALM's states.

    Args:
        model: the IALM.
        compiled: its kernel form.
        config: budget and parameters.
        rng: seeds the search's own random stream.
    """

    def __init__(self, model: IALM, compiled: Model, config: SearchConfig, rng: np.random.Generator) -> None:
        self.model, self.config = model, config
        self.local = LocalModel(compiled, np.ascontiguousarray(model.leaf_values))
        self.tree = allocate(config.simulations + 2, model.dbn.num_actions)
        self.allowed = np.ones(model.dbn.num_actions, np.bool_)
        self._bits = stream(rng)

    def plan(
        self, belief: np.ndarray, allowed: np.ndarray | None = None, spent: float = 0.0
    ) -> tuple[int, dict[str, Any]]:
        """Choose an action.

        Args:
            belief: int16 [P, 2N + 5], equally weighted particles.
            allowed: bool [A], actions that a shield leaves; all by default. The others are not tried at the root.
            spent: seconds that the decision has taken already.

        Returns:
            The action, and what the search saw: values, visits, simulations, nodes, mean and greatest depth, and
            `distinct`, how many different particles the belief held.
        """
        mask = self.allowed if allowed is None else np.asarray(allowed, np.bool_)
        if not mask.any():
            raise UserError("a search needs at least one allowed action")
        clear(self.tree)
        config = self.config
        info = walks(
            self.local,
            belief,
            self.tree,
            config.simulations,
            config.time_left(spent),
            config.depth,
            config.per_step,
            config.exploration,
            False,
            mask,
            self._bits,
        )
        info["distinct"] = len({particle.tobytes() for particle in belief})  # np.unique takes a millisecond
        return best_tried(info, mask), info

    def describe(self, seen: int) -> str:
        """An observation of the tree in words: the robot's motion, and the person's pose if in view (walk)."""
        pose, motion = seen // 4 - 1, self.model.dbn.action_names[seen % 4]
        window = self.model.motion.window
        where = "not in view" if pose < 0 else in_words(pose // 4 // 512 - window, pose // 4 % 512 - window)
        return f"after {motion}: {where}"

    def draw(self, depth: int = 3, format: Literal["dot", "svg"] = "dot") -> str:
        """The tree of the last `plan`, down to `depth` steps, as DOT or SVG text."""
        return drawing_of(self.tree, list(self.model.dbn.action_names), None, depth, format)
