"""Places that experience has shown: what surroundings there are, and what is seen from where in them.

    frame   (X, Y, H): pose relative to where the robot's episode began; (0, 0, 3) is that beginning
    scene   the kinds of cells of one map, put together from what robots and persons saw of it
    station a pose in a scene that can be reached: where a robot or a person may stand
    walk    the least number of actions from a station to a cell, imagined with the learned motions

The robot's way through an episode is dead reckoning with the learned motions of c (motion): a person that
turns on its spot shows how everything at rest moves in the robot's view. What a station shows is the known view
that agrees with the scene wherever it shows anything; it is the robot's code x there, and the person's code y.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from domains.core import GOAL, UNSEEN, WALL
from nesy.compiled import njit
from planners.person_following.motion import NUM_HEADINGS, NUM_MOTIONS
from planners.person_following.structured.frames import AHEAD, FAR, Frame


@dataclass(frozen=True)
class Scenes:
    """A library of scenes; S scenes, at most Q stations and C cells, arrays are padded.

    Attributes:
        keys: int64 [S], what experience calls each map.
        origin: frame coordinates of the corner of `kinds`.
        kinds: uint8 [S, F, F], what each cell is; UNSEEN where no view has shown it.
        ahead, side: int64 [4, 2], as in `Frame`.
        place: int16 [S, C, 2], frame coordinates of each cell.
        pose: int16 [S, Q, 3], frame pose of each station; the first is the beginning.
        cell: int16 [S, Q], the cell of each station.
        follows: int16 [S, Q, motions], the station after a motion that nothing but the scene hinders.
        view: uint8 [S, Q, V, V], what a station shows; UNSEEN too where nothing is known.
        number: int16 [S, F, F, 4], the station at each pose; -1 for none.
        walk: uint8 [S, Q, C], length of the shortest imagined walk to a cell, whatever the heading there.
        sees: bool [S, Q, C], whether a cell is shown at a station.
        goals: int16 [S, G], cells that ever were goals, -1 where there are fewer.
        counts: int64 [S], episodes that began in each.
    """

    keys: np.ndarray
    origin: int
    kinds: np.ndarray
    ahead: np.ndarray
    side: np.ndarray
    place: np.ndarray
    pose: np.ndarray
    cell: np.ndarray
    follows: np.ndarray
    view: np.ndarray
    number: np.ndarray
    walk: np.ndarray
    sees: np.ndarray
    goals: np.ndarray
    counts: np.ndarray

    def station(self, scene: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Stations [n] at frame poses [n, 3] of scenes [n]; -1 where there is none."""
        size = self.kinds.shape[1]
        at = np.asarray(poses, np.int64).copy()
        at[..., :2] -= self.origin
        inside = ((at[..., :2] >= 0) & (at[..., :2] < size)).all(-1)
        at = np.where(inside[..., None], at, 0)
        return np.where(inside, self.number[scene, at[..., 0], at[..., 1], at[..., 2]], -1).astype(np.int64)

    def place_in_view(
        self, scene: np.ndarray, station: np.ndarray, cell: np.ndarray, width: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where in views of a width cells [n] lie that are seen from stations [n]: (vx [n], vy [n])."""
        offset = self.place[scene, cell].astype(np.int64) - self.pose[scene, station, :2]
        heading = self.pose[scene, station, 2].astype(np.int64)
        side = (offset * self.side[heading]).sum(-1)
        ahead = (offset * self.ahead[heading]).sum(-1)
        return side + width // 2, width - 1 - ahead

    def relative(self, scene: np.ndarray, station: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(side, ahead, heading) [n, 3] of stations `other` [n] as seen from stations [n]."""
        offset = self.pose[scene, other, :2].astype(np.int64) - self.pose[scene, station, :2]
        heading = self.pose[scene, station, 2].astype(np.int64)
        turned = (self.pose[scene, other, 2] - heading + AHEAD) % NUM_HEADINGS
        side, ahead = (offset * self.side[heading]).sum(-1), (offset * self.ahead[heading]).sum(-1)
        return np.stack([side, ahead, turned], axis=-1)

    def cell_at(self, scene: int, station: int, place: tuple[int, int]) -> int:
        """The cell at a place (side, ahead) as seen from a station; -1 where there is none."""
        x, y, heading = (int(v) for v in self.pose[scene, station])
        at = np.array([x, y]) + self.side[heading] * place[0] + self.ahead[heading] * place[1]
        found = np.flatnonzero((self.place[scene] == at).all(-1))
        number = self.station(np.array([scene]), np.array([[*at, AHEAD]]))[0]
        return int(found[0]) if len(found) and number >= 0 else -1

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays to be stored."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Scenes:
        """The inverse of `arrays`."""
        origin = int(arrays["origin"])
        return cls(origin=origin, **{name: array for name, array in arrays.items() if name != "origin"})


def learn_scenes(
    frame: Frame, maps: np.ndarray, poses: np.ndarray, views: np.ndarray, begins: np.ndarray, known_views: np.ndarray
) -> Scenes:
    """Put scenes together from what was seen in them.

    Args:
        frame: how poses add up.
        maps: int64 [n], what the map of each view is called.
        poses: int64 [n, 3], from where it was seen, in the frame of its episode.
        views: uint8 [n, V, V], what was seen.
        begins: bool [n], whether an episode begins there.
        known_views: uint8 [K, V, V], all views that there are.
    """
    width = views.shape[1]
    keys, scene = np.unique(maps, return_inverse=True)
    scene = scene.reshape(-1)
    cells = _cells_seen(frame, poses, width)  # [n, V, V, 2]
    origin = int(cells.min()) - 1  # with a border of what nobody has seen
    size = int(cells.max()) - origin + 2
    seen = np.zeros((len(keys), size, size, UNSEEN + 1), np.int64)
    shown = views != UNSEEN
    shown[:, width // 2, width - 1] = False  # its own cell is shown as empty, whatever it is
    at = cells - origin
    where = np.broadcast_to(scene[:, None, None], shown.shape)[shown]
    np.add.at(seen, (where, at[shown][:, 0], at[shown][:, 1], views[shown]), 1)
    begun = tuple(np.array([0, 0]) - origin)
    seen[:, begun[0], begun[1], 0] += 1  # the robot stands there
    kinds = np.where(seen.sum(-1) > 0, seen.argmax(-1), UNSEEN).astype(np.uint8)
    often = seen[..., GOAL] > 0.02 * seen.sum(-1)  # goals are hidden by whoever stands on them, and move
    kinds = np.where(often, GOAL, kinds).astype(np.uint8)
    counts = np.bincount(scene[begins], minlength=len(keys))
    return _library(frame, keys, origin, kinds, known_views, counts)


def _cells_seen(frame: Frame, poses: np.ndarray, width: int) -> np.ndarray:
    """Frame coordinates of every cell of the views from `poses` [n, 3]: int64 [n, V, V, 2]."""
    vx, vy = np.meshgrid(np.arange(width), np.arange(width), indexing="ij")
    relative = np.stack([vx - width // 2, width - 1 - vy, np.full_like(vx, AHEAD)], -1)
    return frame.compose(poses[:, None, None, :], relative[None])[..., :2]


def _library(
    frame: Frame, keys: np.ndarray, origin: int, kinds: np.ndarray, known_views: np.ndarray, counts: np.ndarray
) -> Scenes:
    stations = [_reachable(frame, one, origin) for one in kinds]
    most = max(len(poses) for poses in stations)
    shape = (len(kinds), most)
    pose = np.full((*shape, 3), -128, np.int16)
    cell = np.full(shape, -1, np.int16)
    follows = np.zeros((*shape, NUM_MOTIONS), np.int16)
    view = np.full((*shape, *known_views.shape[1:]), UNSEEN, np.uint8)
    number = np.full((*kinds.shape, NUM_HEADINGS), -1, np.int16)
    cells_of: list[np.ndarray] = []
    for s, poses in enumerate(stations):
        count = len(poses)
        pose[s, :count] = poses
        at = poses - np.array([origin, origin, 0])
        number[s, at[:, 0], at[:, 1], at[:, 2]] = np.arange(count)
        places, of = np.unique(at[:, :2], axis=0, return_inverse=True)
        cells_of.append(places)
        cell[s, :count] = of.reshape(-1)
        for m in range(NUM_MOTIONS):
            after = frame.compose(poses, np.broadcast_to(frame.displacement[m], poses.shape))
            there = after - np.array([origin, origin, 0])
            then = number[s, there[:, 0], there[:, 1], there[:, 2]]
            follows[s, :count, m] = np.where(then >= 0, then, np.arange(count))
        view[s, :count] = _views_at(frame, kinds[s], origin, poses, known_views)
    goals = [np.flatnonzero(kinds[s][tuple(places.T)] == GOAL) for s, places in enumerate(cells_of)]
    goal_cells = np.full((len(kinds), max(1, *(len(g) for g in goals))), -1, np.int16)
    for s, g in enumerate(goals):
        goal_cells[s, : len(g)] = g
    most_cells = max(len(places) for places in cells_of)
    walk = np.full((*shape, most_cells), FAR, np.uint8)
    sees = np.zeros((*shape, most_cells), np.bool_)
    place = np.zeros((len(kinds), most_cells, 2), np.int16)
    for s, places in enumerate(cells_of):
        count = len(stations[s])
        place[s, : len(places)] = places + origin
        _walks(follows[s, :count], cell[s, :count], walk[s, :count])
        shown = view[s, :count] != UNSEEN
        shown[:, shown.shape[1] // 2, shown.shape[2] - 1] = False
        index = np.full(kinds.shape[1:], -1, np.int64)
        index[tuple(places.T)] = np.arange(len(places))
        at = (_cells_seen(frame, pose[s, :count].astype(np.int64), shown.shape[1]) - origin).clip(0, len(index) - 1)
        which = index[at[..., 0], at[..., 1]]
        rows = np.broadcast_to(np.arange(count)[:, None, None], which.shape)
        valid = shown & (which >= 0)
        sees[s, rows[valid], which[valid]] = True
    return Scenes(
        keys,
        origin,
        kinds,
        frame.ahead,
        frame.side,
        place,
        pose,
        cell,
        follows,
        view,
        number,
        walk,
        sees,
        goal_cells,
        counts,
    )


def _reachable(frame: Frame, kinds: np.ndarray, origin: int) -> np.ndarray:
    """Poses that motions lead to from the beginning, over cells that are known and no wall: int64 [Q, 3]."""
    free = (kinds != WALL) & (kinds != UNSEEN)
    found = np.zeros((*kinds.shape, NUM_HEADINGS), np.bool_)
    fresh = np.array([[0, 0, AHEAD]], np.int64)
    order = []
    while len(fresh):
        found[fresh[:, 0] - origin, fresh[:, 1] - origin, fresh[:, 2]] = True
        order.append(fresh)
        after = frame.compose(fresh[:, None], np.broadcast_to(frame.displacement, (len(fresh), NUM_MOTIONS, 3)))
        after = np.unique(after.reshape(-1, 3), axis=0)
        x, y = after[:, 0] - origin, after[:, 1] - origin
        after = after[(x >= 0) & (y >= 0) & (x < len(kinds)) & (y < len(kinds))]
        x, y = after[:, 0] - origin, after[:, 1] - origin
        fresh = after[free[x, y] & ~found[x, y, after[:, 2]]]
    return np.concatenate(order)


def _views_at(frame: Frame, kinds: np.ndarray, origin: int, poses: np.ndarray, known_views: np.ndarray) -> np.ndarray:
    """What each pose shows, uint8 [Q, V, V]: the known view that has nothing otherwise than the scene has it.

    Goals are compared as if they were empty, as they move, and then put where the scene has them. Where no known
    view fits, nothing is shown.
    """
    width = known_views.shape[1]
    at = (_cells_seen(frame, poses, width) - origin).clip(0, len(kinds) - 1)
    truth = kinds[at[..., 0], at[..., 1]].reshape(len(poses), -1)
    plain_truth = np.where(truth == GOAL, 0, truth)
    plain_known = np.unique(np.where(known_views == GOAL, 0, known_views).reshape(len(known_views), -1), axis=0)
    own = width * (width // 2) + width - 1
    shown = plain_known != UNSEEN
    shown[:, own] = False
    best = _best_fits(plain_truth, plain_known, shown)
    fits = best >= 0
    view = np.where(shown[best] & fits[:, None], truth, UNSEEN)
    view[:, own] = 0
    return view.reshape(len(poses), width, width).astype(np.uint8)


@njit(cache=True)
def _best_fits(truth: np.ndarray, known: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """For each row of truth [Q, P] the known view [K, P] without a contradiction that shows most: int64 [Q] or -1."""
    best = np.full(truth.shape[0], -1, np.int64)
    for q in range(truth.shape[0]):
        most = -1
        for k in range(known.shape[0]):
            count = 0
            for i in range(truth.shape[1]):
                if shown[k, i] and truth[q, i] != 3:
                    if known[k, i] != truth[q, i]:
                        count = -1
                        break
                    count += 1
            if count > most:
                most, best[q] = count, k
    return best


@njit(cache=True)
def _walks(follows: np.ndarray, cell: np.ndarray, walk: np.ndarray) -> None:
    """Fill walk [Q, C] by breadth-first search backwards from the stations of each cell."""
    count = follows.shape[0]
    queue = np.zeros(count, np.int64)
    moves = follows.shape[1]
    # stations that lead to each station
    sources = np.full((count, count if count < 64 else 64), -1, np.int64)
    number = np.zeros(count, np.int64)
    for q in range(count):
        for m in range(moves):
            then = follows[q, m]
            if then != q and number[then] < sources.shape[1]:
                sources[then, number[then]] = q
                number[then] += 1
    for c in range(walk.shape[1]):
        head, tail = 0, 0
        for q in range(count):
            if cell[q] == c:
                walk[q, c] = 0
                queue[tail] = q
                tail += 1
        while head < tail:
            q = queue[head]
            head += 1
            for k in range(number[q]):
                source = sources[q, k]
                if walk[source, c] == FAR:
                    walk[source, c] = walk[q, c] + 1
                    queue[tail] = source
                    tail += 1
