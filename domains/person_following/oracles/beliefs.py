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

from domains.core import EMPTY, FORWARD, GOAL, STAY
from domains.person_following.oracles.dynamic_programming import step_tables
from domains.person_following.oracles.full_state import state_shape, sweep
from domains.person_following.oracles.person_chain import PersonChain, pose_views
from domains.person_following.variants import Parameters

KEPT_STEPS = 90
_LABELS_OF_VIEW = 4096  # more than there are configurations
_UNKNOWN = 110.0  # more than any episode can still bring after KEPT_STEPS
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
    """What an action brings: expected reward, and the beliefs that may follow, by what the robot then sees."""

    reward: float
    probabilities: list[float]
    labels: list[int]
    beliefs: list[Belief]
    success: float


class Gains(NamedTuple):
    """What a policy earns in each of W worlds, gathered step by step."""

    value: NDArray[np.float64]  # [W]: discounted
    total: NDArray[np.float64]  # [W]: not discounted
    success: NDArray[np.float64]  # [W]


class Solved(NamedTuple):
    """The full-state optimum of one world."""

    value: float
    total: float
    success: float
    row: NDArray[np.int32]  # [K, P]: row of `kept` for a step and a person state, -1 where it cannot be
    kept: NDArray[np.float32]  # [rows, W, C, G, L]: values of the first K steps


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
        self._number_views()
        self.solved = [self._solve(chain) for chain in chains]

    def _number_views(self) -> None:
        """Number the distinct views, and lay out which of them each robot pose has of each person state."""
        rules = self.parameters
        alone = np.concatenate([pose_views(chain, rules) for chain in self.chains], axis=1)
        # A person seen on a goal hides it, so such views are numbered of their own.
        places, hidden = [], []
        for base, first, chain in zip(self.table_base, self.pose_base, self.chains, strict=True):
            poses = len(chain.poses)
            grids = np.stack([chain.grid, chain.grid_after])
            on_goal = grids[:, chain.person[:, 0], chain.person[:, 1]] == GOAL
            moved, p, c = np.nonzero(on_goal[:, :, None] & (chain.configuration > 0))
            where = (chain.configuration[p, c] - 1) // 4
            views = alone[moved, first + c].reshape(len(c), -1)
            views[np.arange(len(c)), where] = EMPTY
            hidden.append(views)
            places.append(moved * len(self.reward) + base + p * poses + c)
        flat = np.concatenate([alone.reshape(-1, rules.view_size**2), *hidden])
        distinct, number = np.unique(flat, axis=0, return_inverse=True)
        self._number_of_view = {view.tobytes(): k for k, view in enumerate(distinct)}
        count = alone.shape[1]
        shown = number[: 2 * count].reshape(2, count)
        by_pose = [
            np.tile(shown[:, first : first + len(chain.poses)], (1, len(chain.person)))
            for first, chain in zip(self.pose_base, self.chains, strict=True)
        ]
        self.view_number = np.concatenate(by_pose, axis=1).astype(np.int32)  # [2, table]: before and after the move
        self.view_number.reshape(-1)[np.concatenate(places)] = number[2 * count :]

    def _solve(self, chain: PersonChain) -> Solved:
        steps = min(KEPT_STEPS, self.parameters.max_steps)
        kept = np.empty((steps, *state_shape(chain, self.parameters)), np.float32)
        reached = np.zeros((self.parameters.max_steps, *kept.shape[1:3]), np.bool_)
        _, *tables = sweep(chain, self.parameters, self.discount, kept, reached)
        start = chain.pose_index[1, 1, 0]
        value, total, success = (float(table[0, 0, 0, start, 0, 0]) for table in tables)
        there = reached[:steps].any(axis=2)
        row = np.full(there.shape, -1, np.int32)
        row[there] = np.arange(there.sum())
        return Solved(value, total, success, row, kept[there])

    def label(self, view: NDArray[np.uint8], configuration: int) -> int:
        """The number of an observation; -1 where no world shows such a view."""
        number = self._number_of_view.get(view.tobytes(), -1)
        return -1 if number < 0 else number * _LABELS_OF_VIEW + int(configuration)

    def start(self, waiting: int = 0) -> Successor:
        """The beliefs after the first observation."""
        count = len(self.chains)
        particles = np.zeros((count, 6), np.int32)
        particles[:, WORLD] = np.arange(count)
        particles[:, POSE] = [chain.pose_index[1, 1, 0] for chain in self.chains]
        particles[:, WAIT] = waiting
        parts = self._split(0, particles, self.weights.astype(np.float64))
        return _successor(0.0, parts, 0.0)

    def value(self, belief: Belief) -> float:
        """Expected full-state value: an upper bound on what is possible without the full state."""
        if belief.t >= KEPT_STEPS:
            return _UNKNOWN
        total = 0.0
        for particle, weight in zip(belief.particles.tolist(), belief.weights.tolist(), strict=True):
            i, p, w, c, g, lost = particle
            solved = self.solved[i]
            total += weight * float(solved.kept[solved.row[belief.t, p], w, c, g, lost])
        return total

    def step(self, belief: Belief, action: int, gains: Gains | None = None, share: float = 1.0) -> Successor:
        """The exact consequences of an action; `gains`, if given, gets them by world, times `share`."""
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
        weight = weights[index].copy()
        weight[both] *= 0.5
        weight[len(i) :] *= 0.5
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
        if gains is not None:
            np.add.at(gains.value, i, share * weight * reward * self.discount**belief.t)
            np.add.at(gains.total, i, share * weight * reward)
            np.add.at(gains.success, i, share * weight * won)
        parts = self._split(time, following, weight[goes_on])
        return _successor(float(weight @ reward), parts, float(weight @ won))

    def _split(
        self, t: int, particles: NDArray[np.int32], weights: NDArray[np.float64]
    ) -> list[tuple[float, int, Belief]]:
        """Particles by what the robot observes in them, equal ones merged; probabilities are not normalised."""
        if len(particles) == 0:
            return []
        i, p, _, c, _, _ = particles.T.astype(np.int64)
        moved = (t >= self.moved_at[i]).astype(np.int64)
        place = self.table_base[i] + p * self.num_poses[i] + c
        seen, configuration = self.view_number[moved, place], self.configuration[place]
        label = seen.astype(np.int64) * _LABELS_OF_VIEW + configuration
        order = np.lexsort((*particles.T[::-1], label))
        particles, weights, label = particles[order], weights[order], label[order]
        bounds = np.concatenate([[0], np.nonzero(np.diff(label))[0] + 1, [len(label)]])
        parts: list[tuple[float, int, Belief]] = []
        for low, high in pairwise(bounds.tolist()):
            some, share = particles[low:high], weights[low:high]
            if high - low > 1:
                new = np.concatenate([[True], (some[1:] != some[:-1]).any(axis=1)])
                if not new.all():
                    share = np.add.reduceat(share, np.nonzero(new)[0])
                    some = some[new]
            total = float(share.sum())
            parts.append((total, int(label[low]), Belief(t, np.ascontiguousarray(some), share / total)))
        return parts


def _successor(reward: float, parts: list[tuple[float, int, Belief]], success: float) -> Successor:
    return Successor(
        reward, [part[0] for part in parts], [part[1] for part in parts], [part[2] for part in parts], success
    )
