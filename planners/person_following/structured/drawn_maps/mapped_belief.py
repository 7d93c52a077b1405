"""Beliefs over where the person is on the map so far: exact, as there are few poses.

    b(p, lost)   a weight each; the robot's own pose and the map follow from what it did and saw

A step draws the new view into the map, moves every weight on by I(u | l) and weighs it by whether the person was seen
there or not, and by that the episode went on. An influence mode (nesy.perspective.influence) says what the person is
taken to see:

    perspective-shift     what the map says around the person: seen from its place, remembered by the robot
    egocentric            what the map says around the robot
    zero, random          the base: what persons saw, as often as they did
    perfect-information   what the person truly sees is drawn into the map

If nothing explains what was seen, the belief starts afresh: where persons start, or anywhere; counted in `resets`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from domains.core import EMPTY, STAY, UNSEEN, WALL
from nesy.compiled import njit
from nesy.perspective.influence import InfluencePrior, influence
from planners.person_following.motion import NUM_HEADINGS, NUM_MOVES
from planners.person_following.structured.drawn_maps.mapped_model import AROUND, MAX_WALK, MappedModel
from planners.person_following.structured.drawn_maps.mapped_ways import (
    Ground,
    Tables,
    expected_move,
    features,
    ground_of,
    in_sight,
    moves,
)
from planners.person_following.structured.drawn_maps.mapping import Chart, note, patch, walks_to
from planners.person_following.structured.frames import AHEAD

if TYPE_CHECKING:
    from planners.perception import Codec

_CONTRADICTION = 10.0  # nats, for every cell that a view has otherwise than the map
_LEAST_SHARE = 1e-4  # of whether an action moves the robot: tables are never that sure
_RARE = 1e-5  # of the belief: below, a pose is given up


class MappedBelief:
    """A filter for one episode.

    Attributes:
        kinds: uint8 [F, F], the map so far.
        robot: the robot's pose.
        weights: float64 [Q, L], b.
        ground: the map as kernels read it.
        chances: float64 [Q, 4], I(u | p).
        resets: how often nothing explained what was seen.
    """

    def __init__(
        self,
        model: MappedModel,
        tables: Tables,
        codec: Codec,
        mode: str,
        rng: np.random.Generator,
        possible: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        """Before the first episode.

        Args:
            model: learned tables.
            tables: of the model.
            codec: turns what persons are imagined to see into codes.
            mode: of the influence.
            rng: for `random`.
            possible: which moves rules leave to persons with codes uint8 [n, N]: bool [n, moves]; None without rules.
        """
        self.model, self.tables, self.codec, self.prior = model, tables, codec, InfluencePrior(mode, rng)
        self.possible = possible
        self.resets = 0
        self._rows = np.flatnonzero(model.person.slot < 0)

    def reset(self, view: np.ndarray, pose: np.ndarray | None, told: np.ndarray | None = None) -> None:
        """Start an episode.

        Args:
            view: uint8 [V, V], what the robot sees.
            pose: int [3], (side, ahead, heading) of the person if in view, else None.
            told: uint8 [V, V], what the person sees, for `perfect-information`.
        """
        chart = self.model.chart
        self.kinds = chart.blank()
        self.robot = int(chart.number(np.array([0, 0, AHEAD])))
        self.weights = np.zeros((chart.size**2 * NUM_HEADINGS, self.model.num_lost))
        self.weights[self.model.starts[:, 0], 0] = self.model.starts[:, 1]
        self._look(view)
        self._weigh(pose, told)

    def update(self, action: int, view: np.ndarray, pose: np.ndarray | None, told: np.ndarray | None = None) -> float:
        """Take in one step: `action`, and what was seen after it (as in `reset`).

        Returns:
            Log-likelihood of what was seen of the person; -inf if nothing explained it.
        """
        before, ground = self.robot, self.ground
        then = self._moved(action, view)
        carried = carry(self.tables, ground, self.chances, self.weights, before, then, action)
        if carried.sum() > 0:
            self.weights = carried / carried.sum()
        self.robot = then
        self._look(view)
        return self._weigh(pose, told)

    @property
    def effective(self) -> float:
        """How many poses there are."""
        return float((self.weights.sum(1) > 0).sum())

    @property
    def states(self) -> MappedBelief:
        """The belief for a search."""
        return self

    def influence(self) -> np.ndarray:
        """I(u | l) = sum over p of pi(u | p) b(p): float64 [4]."""
        return influence(self.chances, self.weights.sum(1))

    @property
    def window(self) -> int:
        """W of `pose_marginal`."""
        return self.model.chart.size

    def pose_marginal(self) -> np.ndarray:
        """P(c): float64 [2W + 1, 2W + 1, 4] over side, ahead, heading (for pictures)."""
        out = np.zeros((2 * self.window + 1, 2 * self.window + 1, NUM_HEADINGS))
        for p, weight in _positive(self.weights.sum(1)):
            side, ahead, heading = self.model.chart.relative(self.robot, p)
            out[side + self.window, ahead + self.window, heading] += weight
        return out

    def person_marginals(self) -> np.ndarray:
        """P(y_i = k): float64 [N, K], what the person sees where it may be (for pictures)."""
        poses = np.flatnonzero(self.weights.any(1))
        codes = self.codec.codes(views_from(self.tables, self.ground, poses))
        out = np.zeros((codes.shape[1], self.codec.num_values))
        for code, weight in zip(codes, self.weights.sum(1)[poses], strict=True):
            out[np.arange(len(code)), code] += weight
        return out

    def _moved(self, action: int, view: np.ndarray) -> int:
        """Where the robot is after an action: where the motion leads unless its new view speaks for having stayed."""
        if action == STAY:
            return self.robot
        then = int(self.ground.follows[self.robot, action])
        weight = self.weights.sum(1)
        stayed = float(
            sum(w * (1 - moves(self.tables, self.ground, self.robot, action, p)) for p, w in _positive(weight))
        )
        log = [np.log(max(share, _LEAST_SHARE)) for share in (1.0 - stayed, stayed)]
        chart = self.model.chart
        for i, at in enumerate((then, self.robot)):
            log[i] -= _CONTRADICTION * contradictions(chart, self.kinds, view, chart.pose(at))
        return then if log[0] >= log[1] else self.robot

    def _look(self, view: np.ndarray) -> None:
        """Draw a view into the map; what it shows from here is known then, whatever the tables say."""
        note(self.model.chart, self.kinds, view, self.model.chart.pose(self.robot))
        self._shown = (view[:, ::-1].T != UNSEEN).reshape(-1)

    def _weigh(self, pose: np.ndarray | None, told: np.ndarray | None) -> float:
        """Weigh the belief by where the person is seen; what it is expected to do next then follows from the map."""
        chart, tables = self.model.chart, self.tables
        if told is not None and pose is not None:
            note(chart, self.kinds, told, chart.pose(self._place(pose)))
        self.ground = ground_of(tables, self.kinds)
        self.ground.shows[self.robot] = self._shown
        likelihood = np.zeros(len(self.weights))
        if pose is None:
            width, size = tables.width, chart.size
            for p in np.flatnonzero(self.weights.any(1)).tolist():
                likelihood[p] = not in_sight(chart, self.ground.shows, size, width, self.robot, p)
                if told is not None:
                    likelihood[p] *= np.exp(-_CONTRADICTION * contradictions(chart, self.kinds, told, chart.pose(p)))
        else:
            likelihood[self._place(pose)] = 1.0
        weights = self.weights * likelihood[:, None]
        before, total = self.weights.sum(), weights.sum()
        found = float(np.log(total / before)) if total > 0 else -np.inf
        if not total > 0:
            self.resets += 1
            weights = self._afresh(pose)
            total = weights.sum()
        weights = np.where(weights > _RARE * total, weights, 0.0)
        self.weights = weights / weights.sum()
        self._expect()
        return found

    def _place(self, pose: np.ndarray) -> int:
        """The pose of whoever is seen at (side, ahead, heading)."""
        chart = self.model.chart
        x, y, h = chart.pose(self.robot)
        at = np.array([x, y]) + chart.side[h] * pose[0] + chart.ahead[h] * pose[1]
        number = int(chart.number(np.array([*at, (h + pose[2] - AHEAD) % NUM_HEADINGS])))
        return number if number >= 0 else self.robot

    def _afresh(self, pose: np.ndarray | None) -> np.ndarray:
        """The belief when nothing explains what is seen: the person seen, or anywhere out of sight."""
        weights = np.zeros_like(self.weights)
        lost = np.maximum(self.weights.sum(0), 1e-9)
        if pose is not None:
            weights[self._place(pose)] = lost
            return weights
        chart, free = self.model.chart, np.repeat((self.ground.filled != WALL).ravel(), NUM_HEADINGS)
        for p in np.flatnonzero(free).tolist():
            if not in_sight(chart, self.ground.shows, chart.size, self.tables.width, self.robot, p):
                weights[p] = lost
        return weights if weights.sum() > 0 else weights + 1.0

    def _expect(self) -> None:
        """I(u | p) for every pose, as the influence mode has it."""
        count = len(self.weights)
        if self.prior.blind:
            self.prior.renew()
            often = self.prior.base(self.model.person.moments[self._rows].sum(1))
            self.chances = np.tile(influence(self.tables.policy[self._rows], often), (count, 1))
        else:
            seen_from = self.robot if self.prior.mode == "egocentric" else -1
            self.chances = expected_moves(self.tables, self.ground, seen_from)
        if self.possible is not None:
            poses = np.flatnonzero(np.repeat((self.ground.filled != WALL).ravel(), NUM_HEADINGS))
            allowed = self.possible(self.codec.codes(views_from(self.tables, self.ground, poses)))
            kept = self.chances[poses]
            kept[:, : allowed.shape[1]] *= allowed
            total = kept.sum(1, keepdims=True)
            self.chances[poses] = np.where(total > 1e-12, kept / np.maximum(total, 1e-12), self.chances[poses])


def views_from(tables: Tables, ground: Ground, poses: np.ndarray) -> np.ndarray:
    """What poses [n] show on the map, with what is usual where nothing is known: uint8 [n, V, V]."""
    width = tables.width
    rows = np.zeros((len(poses), width * width), np.uint8)
    for row, q in zip(rows, poses.tolist(), strict=True):
        patch(tables.chart, ground.filled, q, width // 2, 0, width - 1, WALL, row)
        row[~ground.shows[q]] = UNSEEN
        row[width // 2] = EMPTY  # its own cell
    return np.ascontiguousarray(rows.reshape(-1, width, width).transpose(0, 2, 1)[:, :, ::-1])


def _positive(weights: np.ndarray) -> list[tuple[int, float]]:
    rows = np.flatnonzero(weights > 0)
    return list(zip(rows.tolist(), weights[rows].tolist(), strict=True))


@njit(cache=True)
def expected_moves(tables: Tables, ground: Ground, seen_from: int) -> np.ndarray:
    """pi(u | y) at every pose, float64 [Q, 4]: y is what lies around it, or around `seen_from` if not -1."""
    count = ground.follows.shape[0]
    size = ground.kinds.shape[0]
    out = np.zeros((count, NUM_MOVES))
    variables = np.zeros(AROUND + 3, np.int32)
    for p in range(count):
        if ground.filled[p // NUM_HEADINGS // size, p // NUM_HEADINGS % size] != WALL:
            row = expected_move(tables, ground.kinds, p, p if seen_from < 0 else seen_from, variables)
            out[p] = tables.policy[row]
        else:
            out[p, STAY] = 1.0
    return out


@njit(cache=True)
def carry(
    tables: Tables, ground: Ground, chances: np.ndarray, weights: np.ndarray, before: int, then: int, action: int
) -> np.ndarray:
    """b(p, lost) [Q, L] one step on, weighed by that the robot came from `before` to `then` and the episode went on."""
    out = np.zeros_like(weights)
    count = weights.shape[0]
    walk, queue = np.zeros(count, np.uint8), np.zeros(count, np.int64)
    size = ground.filled.shape[0]
    for p in range(count):
        total = weights[p].sum()
        if total <= 0.0:
            continue
        moved = moves(tables, ground, before, action, p)
        share = moved if then != before else 1.0 - moved
        for u in range(NUM_MOVES):
            chance = max(share, _LEAST_SHARE) * chances[p, u]
            if chance * total < 1e-9:
                continue
            after = ground.follows[p, u] if u != STAY else p
            walks_to(ground.comes, after, MAX_WALK, walk, queue)
            far, at, enters, ahead, same = features(ground.filled, ground.follows, walk, before, then, action, after)
            sight = 1 if in_sight(tables.chart, ground.shows, size, tables.width, then, after) else 0
            for k in range(weights.shape[1]):
                goes_on = tables.judgement[far, sight, at, k, enters, ahead, same, 1]
                out[after, tables.next_lost[far, k]] += weights[p, k] * chance * max(goes_on, 1e-6)
    return out


@njit(cache=True)
def contradictions(chart: Chart, kinds: np.ndarray, view: np.ndarray, pose: np.ndarray) -> int:
    """In how many cells a view [V, V] from a frame pose says wall where the map says none, or the other way round."""
    width, size, h = view.shape[0], kinds.shape[0], pose[2]
    wrong = 0
    for vx in range(width):
        for vy in range(width):
            s, f = vx - width // 2, width - 1 - vy
            x = pose[0] + chart.side[h, 0] * s + chart.ahead[h, 0] * f - chart.origin[0]
            y = pose[1] + chart.side[h, 1] * s + chart.ahead[h, 1] * f - chart.origin[1]
            kind = view[vx, vy]
            if kind == UNSEEN or (s == 0 and f == 0) or x < 0 or y < 0 or x >= size or y >= size:
                continue
            if kinds[x, y] != UNSEEN and (kinds[x, y] == WALL) != (kind == WALL):
                wrong += 1
    return wrong
