"""Leaf values for the search: value iteration on the relational part of the model.

    S   (c, lost): the person's relative pose and the lost counter, everything else averaged out
    A   the robot's motions, taken to be free of obstacles
    T   u ~ P(u | c after the robot's motion), c' by the learned maps, lost' by a learned table
    R   E[r | c', lost'] and P(end | c', lost'), averaged over the logged experience

The fixed point is what being at (c, lost) is worth on average to a robot that knows c and is not blocked. It is
an estimate, not a bound: it leaves out walls (too high) and lets the person act without seeing (too low).
"""

from __future__ import annotations

import numpy as np

from planners.models.tables import DecisionTable
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS, NUM_MOVES, WAIT, RelativeMotion


def relational_values(
    motion: RelativeMotion,
    person: DecisionTable,
    reward: DecisionTable,
    end: DecisionTable,
    next_lost: DecisionTable,
    discount: float,
    sweeps: int = 80,
) -> np.ndarray:
    """Solve the relational decision process.

    Args:
        motion: the learned maps of c.
        person: P(u | mid c), 4 classes; parents in slots 0..2 (side, ahead, heading).
        reward: E[r | c', lost'], parents in slots 0..3.
        end: P(end | c', lost'), 2 classes, parents in slots 0..3.
        next_lost: P(lost' | c', lost), parents in slots 0..3.
        discount: per step.
        sweeps: sweeps of value iteration.

    Returns:
        float64 [2W + 1, 2W + 1, 4, L]: value of (side, ahead, heading, lost), L the number of lost counts.
    """
    size = 2 * motion.window + 1
    num_lost = next_lost.moments.shape[1]
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size), np.arange(NUM_HEADINGS), indexing="ij"), -1)
    poses = grid.reshape(-1, 3)
    plain = poses - np.array([motion.window, motion.window, 0])
    count = len(poses)

    def index(shifted: np.ndarray) -> np.ndarray:
        return (shifted[:, 0] * size + shifted[:, 1]) * NUM_HEADINGS + shifted[:, 2]

    def rows(table: DecisionTable) -> np.ndarray:
        variables = np.concatenate([np.tile(poses, (num_lost, 1)), np.repeat(np.arange(num_lost), count)[:, None]], 1)
        return table.estimates()[table.locate(variables)].reshape(num_lost, count, -1)

    gain = rows(reward)[..., 0]  # [lost', c']
    goes_on = rows(end)[..., 0]
    lost_chance = rows(next_lost)  # [lost, c', lost']
    moves = person.estimates()[person.locate(poses)]  # [mid c, u]
    after = np.empty((NUM_MOTIONS, NUM_MOVES, count), np.int64)
    chance = np.empty((NUM_MOTIONS, count, NUM_MOVES))
    for m in range(NUM_MOTIONS):
        middle = motion.apply(plain, np.full(count, m), np.full(count, WAIT))
        chance[m] = moves[index(motion.shifted(middle))]
        for u in range(NUM_MOVES):
            after[m, u] = index(motion.shifted(motion.apply(plain, np.full(count, m), np.full(count, u))))
    value = np.zeros((num_lost, count))
    for _ in range(sweeps):
        arrival = gain + discount * goes_on * value  # [lost', c']
        expected = np.einsum("lcm,mc->lc", lost_chance, arrival)  # [lost, c']
        best = np.full((num_lost, count), -np.inf)
        for m in range(NUM_MOTIONS):
            here = sum(chance[m][:, u] * expected[:, after[m, u]] for u in range(NUM_MOVES))
            best = np.maximum(best, here)
        value = best
    return np.ascontiguousarray(value.T.reshape(size, size, NUM_HEADINGS, num_lost))
