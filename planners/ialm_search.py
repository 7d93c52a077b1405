"""Online tree search in the influence-augmented local model (PO-UCT with leaf values from the model).

The tree branches on what matters for influence and reward: the person's pose if in view (else that it is not),
and whether the robot's own move succeeded. The 8^8 codes are sampled along, but not branched on; so the tree
goes deep with few simulations, at the price of plans that do not depend on what the robot will see of the walls.
Sources: Silver and Veness 2010 (PO-UCT); Kocsis and Szepesvari 2006 (UCB1).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from nesy.compiled import njit
from planners import ialm, kernels
from planners.config import SearchConfig
from planners.ialm import IALM, SCALARS
from planners.kernels import Model
from planners.random_bits import stream, uniform
from planners.tree import Tree, allocate, backup, best_by_ucb, clear, find_child

_CHUNK = 64  # simulations between two looks at the clock


class IALMSearch:
    """Plans in a particle belief over the IALM's states.

    Args:
        model: the IALM.
        compiled: its kernel form.
        config: budget and parameters.
        rng: seeds the search's own random stream.
    """

    def __init__(self, model: IALM, compiled: Model, config: SearchConfig, rng: np.random.Generator) -> None:
        self.model, self.compiled, self.config = model, compiled, config
        self.tree = allocate(config.simulations + 2, model.dbn.num_actions)
        self.allowed = np.ones(model.dbn.num_actions, np.bool_)
        self._bits = stream(rng)

    def plan(self, belief: np.ndarray, allowed: np.ndarray | None = None) -> tuple[int, dict[str, Any]]:
        """Choose an action.

        Args:
            belief: int16 [P, 2N + 5], equally weighted particles.
            allowed: bool [A], actions that a shield leaves; all by default.

        Returns:
            The action, and what the search saw: values, visits, simulations, nodes, mean and greatest depth.
        """
        mask = self.allowed if allowed is None else np.asarray(allowed, np.bool_)
        if not mask.any():
            raise ValueError("a search needs at least one allowed action")
        clear(self.tree)
        depths = np.zeros(2, np.int64)
        started = time.perf_counter()
        done = 0
        config = self.config
        chunk = _CHUNK if config.time_limit > 0 else config.simulations
        while done < config.simulations:
            if config.time_limit > 0 and done and time.perf_counter() - started >= config.time_limit:
                break
            count = min(chunk, config.simulations - done)
            _simulate(
                self.compiled,
                self.tree,
                belief,
                self.model.leaf_values,
                count,
                config.depth,
                config.discount,
                config.exploration,
                mask,
                self._bits,
                depths,
            )
            done += count
        visits, values = self.tree.q_visits[0].copy(), self.tree.q_value[0].copy()
        action = int(np.where(visits > 0, values, -np.inf).argmax())
        return action, {
            "values": values.tolist(),
            "visits": visits.tolist(),
            "simulations": done,
            "nodes": int(self.tree.size[0]),
            "mean_depth": float(depths[0] / max(done, 1)),
            "max_depth": int(depths[1]),
        }

    def observation_name(self, observation: int) -> str:
        """What a branch of the tree stands for, in words (see `_simulate`)."""
        moved = self.model.dbn.action_names[observation % 4]
        if observation < 4:
            return f"after {moved}: not in view"
        pose = observation // 4 - 1
        window = self.model.motion.window
        side, ahead = pose // 4 // 512 - window, pose // 4 % 512 - window
        return f"after {moved}: {place_name(side, ahead)}"


def place_name(side: int, ahead: int) -> str:
    """A relative place in words."""
    across = f"{abs(side)} {'right' if side > 0 else 'left'}" if side else ""
    along = f"{abs(ahead)} {'ahead' if ahead > 0 else 'behind'}" if ahead else ""
    return ", ".join(filter(None, (across, along))) or "same place"


@njit(cache=True)
def _simulate(
    model: Model,
    tree: Tree,
    belief: np.ndarray,
    leaf_values: np.ndarray,
    count: int,
    depth: int,
    discount: float,
    exploration: float,
    allowed: np.ndarray,
    bits: np.ndarray,
    depths: np.ndarray,
) -> None:
    n = model.dbn.order.shape[0]
    variables = np.zeros(3 * n + len(SCALARS), np.int16)
    state = np.zeros(2 * n + 5, np.int16)
    after = np.zeros(2 * n + 5, np.int16)
    nodes = np.zeros(depth, np.int64)
    actions = np.zeros(depth, np.int64)
    rewards = np.zeros(depth)
    everything = np.ones(tree.q_value.shape[1], np.bool_)
    last_lost = leaf_values.shape[3] - 1
    for _ in range(count):
        particle = belief[np.int64(uniform(bits) * belief.shape[0])]
        for i in range(state.shape[0]):
            state[i] = particle[i]
        node, length, value = 0, 0, 0.0
        while length < depth:
            action = best_by_ucb(tree, node, exploration, allowed if node == 0 else everything)
            reward, outcome, visible = kernels.step(model, state, action, after, variables, bits)
            nodes[length], actions[length], rewards[length] = node, action, reward
            length += 1
            if outcome != 0:
                value = 0.0
                break
            for i in range(state.shape[0]):
                state[i] = after[i]
            value = leaf_values[state[2 * n], state[2 * n + 1], state[2 * n + 2], min(state[2 * n + 4], last_lost)]
            observation = int(variables[3 * n + ialm.MOTION])
            if visible != 0:
                pose = (int(state[2 * n]) * 512 + state[2 * n + 1]) * 4 + state[2 * n + 2]
                observation += 4 * (pose + 1)
            node = find_child(tree, node, action, observation, True)
            if node < 0:
                break
        backup(tree, nodes, actions, rewards, length, value, discount)
        depths[0] += length
        depths[1] = max(depths[1], length)
