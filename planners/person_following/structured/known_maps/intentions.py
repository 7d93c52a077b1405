"""What persons head for, learned from logged episodes in which nobody says it.

    z   the goal cell that the person heads for; g the one that is its own now (elsewhere once the goal has moved)
    pi  P(u | which actions shorten the imagined walk to z, whether z is reached), and counts by place on top

z is never logged. Expectation maximisation finds it: the weight of a candidate in an episode is the product of pi
over the person's actions, and pi is learned from actions with those weights. A person that sees z without a goal
heads for another candidate from then on; what it sees is in the log (`person_view`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from domains.core import GOAL, UNSEEN
from nesy.errors import UserError
from planners.models.tables import DecisionTable, Parents, learn_distribution
from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.frames import FAR
from planners.person_following.structured.known_maps.scenes import Scenes

if TYPE_CHECKING:
    from nesy.log.experience import Experience

WAYS = Parents(("left_nearer", "right_nearer", "forward_nearer", "there"), (0, 1, 2, 3), (False,) * 4)
"""What pi asks about a person's place and z."""
ABSENT, PRESENT, UNKNOWN = 0, 1, 2
_ROUNDS = 12
_FLOOR = 1e-3


@dataclass(frozen=True)
class Intentions:
    """What is learned about what persons head for.

    Attributes:
        ways: P(u | parents `WAYS`).
        counts: float64 [S, G, Q, 4], expected counts of the person's actions by scene, z and station.
        prior: float64 [S, G], P(z | scene).
        vanish: float64 [T, 2, 2], how often (stayed, vanished) the person's own goal was met at t + 1 where it was at
            t, by whether the person saw it at t.
        starts: int64 [n, 3], (scene, station, count) of persons at the start of episodes.
    """

    ways: DecisionTable
    counts: np.ndarray
    prior: np.ndarray
    vanish: np.ndarray
    starts: np.ndarray


def ways_to(scenes: Scenes, scene: np.ndarray, station: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The variables of `WAYS` for persons at stations [n] and cells [n] of scenes [n]: int32 [n, 4]."""
    here = scenes.walk[scene, station, cell].astype(np.int64)
    after = scenes.follows[scene, station][:, :3].astype(np.int64)
    then = scenes.walk[scene[:, None], after, cell[:, None]].astype(np.int64)
    nearer = (then < here[:, None]) & (here[:, None] < FAR)
    return np.concatenate([nearer, (here == 0)[:, None]], axis=1).astype(np.int32)


def shown_at(scenes: Scenes, scene: np.ndarray, station: np.ndarray, views: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """What views [n, V, V] from stations [n] show of goal cells [n]: ABSENT, PRESENT, or UNKNOWN where out of sight."""
    out = np.full(len(scene), UNKNOWN, np.int8)
    rows = np.flatnonzero((cell >= 0) & (station >= 0))
    rows = rows[scenes.sees[scene[rows], station[rows], cell[rows]]]
    vx, vy = scenes.place_in_view(scene[rows], station[rows], cell[rows], views.shape[1])
    kind = views[rows, vx, vy]
    out[rows] = np.where(kind == GOAL, PRESENT, np.where(kind == UNSEEN, UNKNOWN, ABSENT))
    return out


def learn_intentions(
    scenes: Scenes, experience: Experience, scene: np.ndarray, robot: np.ndarray, person: np.ndarray
) -> tuple[Intentions, np.ndarray, np.ndarray]:
    """Learn from whole episodes of person following.

    Args:
        scenes: the library.
        experience: the episodes.
        scene: int64 [n], where each step is.
        robot: int64 [n], the robot's station before each step.
        person: int64 [n], the person's.

    Returns:
        What is learned; P(z | the whole episode) float64 [n, G]; and whether a candidate that the person heads for at
        first is given up before each step, bool [n, G].
    """
    goals = scenes.goals[scene].astype(np.int64)  # [n, G]
    begins = np.flatnonzero(np.r_[True, np.diff(experience.episode) != 0])
    episode = np.cumsum(np.r_[0, np.diff(experience.episode) != 0])
    number, most = len(begins), goals.shape[1]
    moves = experience.person_action.astype(np.int64)
    ways = np.zeros((most, len(moves), 4), np.int32)
    shown = np.full((len(moves), most), UNKNOWN, np.int8)
    for k in range(most):
        valid = goals[:, k] >= 0
        ways[k, valid] = ways_to(scenes, scene[valid], person[valid], goals[valid, k])
        shown[:, k] = shown_at(scenes, scene, person, experience.person_view, goals[:, k])
    given_up = _running_any(shown == ABSENT, begins)
    prior = scenes.goals >= 0
    if blank := int((~prior.any(axis=1)).sum()):
        raise UserError(
            f"{blank} of {len(prior)} maps met have shown no goal yet, so nobody can be told to head for one; "
            "practise more (--search.practice-episodes)"
        )
    log_prior = np.where(prior, 0.0, -np.inf)[scene[begins]]
    # at first: whoever is not there yet takes a way that is nearer
    likely = np.where(ways[..., :3] > 0, 1.0, 0.05)
    likely = np.concatenate([likely, np.where(ways[..., 3:] > 0, 4.0, 0.05)], axis=-1)
    chance = (likely / likely.sum(-1, keepdims=True))[:, np.arange(len(moves)), moves].T  # [n, G]
    events = _vanishings(scenes, experience, scene, robot, person, shown, goals)
    context = (ways * (8, 4, 2, 1)).sum(-1).T * NUM_MOVES + moves[:, None]  # [n, G]
    heads, vanish = np.zeros_like(chance), np.zeros((2, 0, 2, 2))
    for step in range(_ROUNDS):
        if step:
            pairs = np.bincount(context.ravel(), heads.ravel(), 16 * NUM_MOVES).reshape(16, NUM_MOVES) + _FLOOR
            chance = (pairs / pairs.sum(1, keepdims=True)).ravel()[context]
        others = _others(chance, goals >= 0)
        log = np.log(np.where(given_up, others, chance))
        total = np.zeros((number, most))
        np.add.at(total, episode, np.where(goals >= 0, log, 0.0))
        total += log_prior
        if step:
            np.add.at(total, episode[events.rows], events.evidence(vanish, most))
        weights = np.exp(total - total.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        heads = _heading(weights[episode], given_up, goals >= 0)  # [n, G]
        vanish = events.counts(weights[episode])
    table = learn_distribution(
        ways.reshape(-1, 4), WAYS, np.tile(moves, most), NUM_MOVES, np.ascontiguousarray(heads.T).reshape(-1)
    )
    counts = np.zeros((*scenes.goals.shape, scenes.pose.shape[1], NUM_MOVES))
    for k in range(most):
        np.add.at(counts, (scene, np.full(len(scene), k), person, moves), heads[:, k])
    found = np.zeros(scenes.goals.shape)
    np.add.at(found, scene[begins], weights)
    chance_of = np.where(prior, found + 1.0, 0.0)
    started, often = np.unique(np.stack([scene[begins], person[begins]], 1), axis=0, return_counts=True)
    own = weights[episode]
    learned = Intentions(
        table,
        counts,
        chance_of / chance_of.sum(1, keepdims=True),
        vanish[0],
        np.concatenate([started, often[:, None]], axis=1),
    )
    return learned, own, given_up


def _running_any(flags: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Whether a flag [n, G] was set at this step or earlier in its episode."""
    sums = np.cumsum(flags, axis=0)
    before = np.zeros_like(sums)
    lengths = np.diff(np.r_[begins, len(flags)])
    before[:] = np.repeat((sums - flags)[begins], lengths, axis=0)
    return np.asarray(sums - before > 0)


def _others(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mean over the other valid candidates: [n, G] -> [n, G]; 1e-3 where there is no other."""
    kept = np.where(valid, values, 0.0)
    number = valid.sum(1, keepdims=True) - valid
    return np.where(number > 0, (kept.sum(1, keepdims=True) - kept) / np.maximum(number, 1), 1e-3)


def _heading(weights: np.ndarray, given_up: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """How much each candidate is headed for at each step [n, G]: given up, its weight goes to the others alike."""
    staying = np.where(given_up, 0.0, weights)
    leaving = np.where(given_up, weights, 0.0)
    number = np.maximum(valid.sum(1, keepdims=True) - 1, 1)
    received = (leaving.sum(1, keepdims=True) - leaving) / number
    return np.where(valid, staying + received, 0.0)


class _Events(NamedTuple):
    """Goals that are known to have been there at t, and known to be there or not at t + 1: E of them.

    Attributes:
        rows: int64 [E], the step.
        which: int64 [E], the candidate.
        t: int64 [E].
        seen: int64 [E], whether the person saw it at t.
        gone: int64 [E].
    """

    rows: np.ndarray
    which: np.ndarray
    t: np.ndarray
    seen: np.ndarray
    gone: np.ndarray

    def counts(self, own: np.ndarray) -> np.ndarray:
        """Of persons' own goals and of the others: float64 [2, T, 2, 2] by (t, seen, gone); `own` [n, G]."""
        out = np.zeros((2, int(self.t.max(initial=0)) + 1, 2, 2))
        weight = own[self.rows, self.which]
        np.add.at(out[0], (self.t, self.seen, self.gone), weight)
        np.add.at(out[1], (self.t, self.seen, self.gone), 1.0 - weight)
        return out

    def evidence(self, counts: np.ndarray, candidates: int) -> np.ndarray:
        """Log P(event | candidate k is the person's own), float64 [E, G]."""
        smoothed = counts + 0.5 * np.array([0.99, 0.01])
        logs = np.log(smoothed / smoothed.sum(-1, keepdims=True))
        own, other = (logs[i][self.t, self.seen, self.gone] for i in range(2))
        return np.where(self.which[:, None] == np.arange(candidates), own[:, None], other[:, None])


def _vanishings(
    scenes: Scenes,
    experience: Experience,
    scene: np.ndarray,
    robot: np.ndarray,
    person: np.ndarray,
    shown: np.ndarray,
    goals: np.ndarray,
) -> _Events:
    state = np.full(goals.shape, UNKNOWN, np.int8)
    for k in range(goals.shape[1]):
        by_robot = shown_at(scenes, scene, robot, experience.view, goals[:, k])
        # whoever stands on a goal hides it
        covered = scenes.cell[scene, person] == goals[:, k]
        covered |= scenes.cell[scene, robot] == goals[:, k]
        merged = np.where(shown[:, k] != UNKNOWN, shown[:, k], by_robot)
        state[:, k] = np.where(covered | (goals[:, k] < 0), UNKNOWN, merged)
    follows = np.zeros(len(scene), np.bool_)
    follows[:-1] = (experience.episode[1:] == experience.episode[:-1]) & (experience.t[1:] == experience.t[:-1] + 1)
    then = np.roll(state, -1, axis=0)
    rows, which = np.nonzero(follows[:, None] & (state == PRESENT) & (then != UNKNOWN))
    return _Events(
        rows,
        which,
        experience.t[rows].astype(np.int64) - int(experience.t.min()),
        (shown[rows, which] != UNKNOWN).astype(np.int64),
        (then[rows, which] == ABSENT).astype(np.int64),
    )
