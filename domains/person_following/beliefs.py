"""Sets of possible worlds, as the oracles under partial observability see them.

    particle    (world i, person state p, waiting w, robot pose c, steps at the goal g, lost counter l), weight
    belief      the particles that agree with all actions and observations so far, weights summing to 1

A world is a map with the person's own goal, as a `PersonChain`. Tables of all worlds lie flat behind each
other, so that one step of a whole belief is a handful of array operations.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from domains.core import FORWARD, STAY
from domains.person_following.dynamic_programming import step_tables
from domains.person_following.oracles import state_shape, sweep
from domains.person_following.person_chain import PersonChain, pose_views
from domains.person_following.variants import Parameters

KEPT_STEPS = 90
WORLD, PERSON, WAIT, POSE, STOOD, LOST_COUNT = range(6)


class Belief(NamedTuple):
    """n particles at the beginning of step t."""

    t: int
    particles: NDArray[np.int32]  # [n, 6]
    weights: NDArray[np.float64]  # [n]

    def key(self) -> bytes:
        """Equal for equal beliefs; particles are kept sorted."""
        return self.t.to_bytes(2, "big") + self.particles.tobytes() + np.round(self.weights, 9).tobytes()


class Successor(NamedTuple):
    """What an action brings: expected reward, and the beliefs that may follow, with probabilities."""

    reward: float
    probabilities: list[float]
    beliefs: list[Belief]
    success: float


class Worlds:
    """All worlds of a variant, solved with the full state, ready to be stepped as beliefs."""

    def __init__(
        self,
        chains: list[PersonChain],
        weights: NDArray[np.float64],
        parameters: Parameters,
        discount: float,
    ) -> None:
        """Solve all worlds and lay their tables behind each other."""
        self.chains, self.weights, self.parameters, self.discount = chains, weights, parameters, discount
        tables = [step_tables(chain, parameters) for chain in chains]
        sizes = [chain.distance.shape for chain in chains]
        self.person_base = np.cumsum([0] + [p for p, _ in sizes[:-1]])
        self.pose_base = np.cumsum([0] + [c for _, c in sizes[:-1]])
        self.table_base = np.cumsum([0] + [p * c for p, c in sizes[:-1]])
        self.num_poses = np.array([c for _, c in sizes])
        self.reward = np.concatenate([t.reward.ravel() for t in tables])
        self.bump = np.concatenate([t.bump.ravel() for t in tables])
        self.far = np.concatenate([t.far.ravel() for t in tables])
        self.won = np.concatenate([t.won.ravel() for t in tables])
        self.waits = np.concatenate([t.waits.ravel() for t in tables])
        self.moves = np.concatenate([t.moves.reshape(-1, 4) for t in tables])
        self.configuration = np.concatenate([chain.configuration.ravel() for chain in chains])
        self.successors = np.concatenate([chain.successors for chain in chains])
        self.at_goal = np.concatenate([chain.at_goal for chain in chains])
        self.enters = np.concatenate([t.enters for t in tables], axis=1)
        self.moved_at = np.array([chain.moved_at for chain in chains])
        views = np.concatenate([pose_views(chain, parameters) for chain in chains], axis=1)
        flat = views.reshape(-1, parameters.view_size**2)
        _, number = np.unique(flat, axis=0, return_inverse=True)
        self.view_number = number.reshape(views.shape[:2])
        self.values, self.policies = [], []
        for chain in chains:
            kept = np.empty((KEPT_STEPS, *state_shape(chain, parameters)), np.float32)
            policy, *_ = sweep(chain, parameters, discount, kept)
            self.values.append(kept)
            self.policies.append(policy)

    def start(self) -> list[tuple[float, Belief]]:
        """The beliefs after the first observation, with their probabilities."""
        count = len(self.chains)
        particles = np.zeros((count, 6), np.int32)
        particles[:, WORLD] = np.arange(count)
        particles[:, POSE] = [chain.pose_index[1, 1, 0] for chain in self.chains]
        return self._split(0, particles, self.weights.astype(np.float64))

    def value(self, belief: Belief) -> float:
        """Expected full-state value: an upper bound on what is possible without the full state."""
        if belief.t >= KEPT_STEPS:
            return 110.0
        total = 0.0
        for particle, weight in zip(belief.particles.tolist(), belief.weights.tolist(), strict=True):
            i, *state = particle
            total += weight * float(self.values[i][(belief.t, *state)])
        return total

    def step(self, belief: Belief, action: int) -> Successor:
        """The exact consequences of an action."""
        rules = self.parameters
        time = belief.t + 1
        particles, weights = belief.particles, belief.weights
        i, p, w, c, g, lost = particles.T.astype(np.int64)
        if rules.robot_rest and time % rules.robot_rest == 0:
            action = STAY
        width = self.num_poses[i]
        to = self.moves[self.table_base[i] + p * width + c, action]
        moved = (time >= self.moved_at[i]).astype(np.int64)
        entered = np.zeros(len(i), np.bool_)
        if action == FORWARD:
            entered = (to != c) & self.enters[moved, self.pose_base[i] + c]
        stays = self.waits[self.table_base[i] + p * width + to] & (w + 1 < 3)
        if rules.person_rest and time % rules.person_rest == 0:
            stays = np.ones(len(i), np.bool_)
            waiting = w
        else:
            waiting = np.where(stays, w + 1, 0)
        pairs = self.successors[self.person_base[i] + p]
        first = np.where(stays, p, pairs[:, 0])
        second = np.where(stays, p, pairs[:, 1])
        both = np.nonzero(first != second)[0]
        index = np.concatenate([np.arange(len(i)), both])
        after = np.concatenate([first, second[both]])
        share = weights[index].copy()
        share[both] *= 0.5
        share[len(i) :] *= 0.5
        i, to, waiting, entered = i[index], to[index], waiting[index], entered[index]
        place = self.table_base[i] + after * self.num_poses[i] + to
        reward = self.reward[place] + (self.bump[place] if action == FORWARD else 0.0)
        reward = reward + entered * (1.0 - 0.9 * time / rules.max_steps)
        at_goal = self.at_goal[self.person_base[i] + after]
        stood = np.where(at_goal, np.minimum(g[index] + 1, rules.goal_patience + 1), 0)
        far = self.far[place]
        lost = np.where(far, lost[index] + 1, 0)
        won = self.won[place]
        ended = entered | won | (lost >= rules.max_lost) | (far & at_goal & (stood > rules.goal_patience))
        ended |= time >= rules.max_steps
        goes_on = ~ended
        following = np.stack([i, after, waiting, to, stood, lost], axis=1).astype(np.int32)[goes_on]
        parts = self._split(time, following, share[goes_on])
        return Successor(float(share @ reward), [part for part, _ in parts], [b for _, b in parts], float(share @ won))

    def _split(self, t: int, particles: NDArray[np.int32], weights: NDArray[np.float64]) -> list[tuple[float, Belief]]:
        """Particles by what the robot observes in them, equal ones merged; probabilities are not normalised."""
        if len(particles) == 0:
            return []
        i, p, _, c, _, _ = particles.T.astype(np.int64)
        moved = (t >= self.moved_at[i]).astype(np.int64)
        seen = self.view_number[moved, self.pose_base[i] + c]
        configuration = self.configuration[self.table_base[i] + p * self.num_poses[i] + c]
        label = seen * 4096 + configuration
        order = np.lexsort((*particles.T[::-1], label))
        particles, weights, label = particles[order], weights[order], label[order]
        bounds = np.concatenate([[0], np.nonzero(np.diff(label))[0] + 1, [len(label)]])
        parts = []
        for low, high in pairwise(bounds.tolist()):
            some, share = particles[low:high], weights[low:high]
            if high - low > 1:
                new = np.concatenate([[True], (some[1:] != some[:-1]).any(axis=1)])
                if not new.all():
                    share = np.add.reduceat(share, np.nonzero(new)[0])
                    some = some[new]
            total = float(share.sum())
            parts.append((total, Belief(t, np.ascontiguousarray(some), share / total)))
        return parts
