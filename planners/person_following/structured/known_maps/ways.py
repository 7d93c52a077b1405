"""The ways that persons may go, imagined with the learned model, and what a robot can still earn on each.

    node    (s, t, p, z, g, gone, n): a scene, the clock, the person's station, the goal that it heads for, the goal
            that is its own, the one that has vanished (-1: none), for how many steps it has stood at its goal
    V       [node, q, lost]: the value of the robot's best way if all this were known; for leaves of a search

Nodes are made when they are first met, with all that may follow, and kept: a robot that knows a scene has walked
through it in thought before. V goes backwards through them. What is less probable than `_RARE` is left out of V.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from domains.core import FORWARD, GOAL, STAY
from nesy.compiled import njit
from planners.person_following.motion import NUM_MOVES
from planners.person_following.structured.known_maps.mind_checks import PERIOD
from planners.person_following.structured.known_maps.minds import MAX_STANDING, MAX_WALK, MindModel

if TYPE_CHECKING:
    from planners.perception import Codec

Node = tuple[int, int, int, int, int, int, int]
SCENE, CLOCK, PLACE, HEADS_FOR, OWN, GONE, STANDING = range(7)
_RARE = 0.01
_MOST = 6
"""Successors kept of a node."""


class PackedWays(NamedTuple):
    """What kernels read; N nodes, S scenes, Q stations, G candidates."""

    node: np.ndarray  # int64 [N, 7]
    successor: np.ndarray  # int64 [N, M], -1 for none
    chance: np.ndarray  # float64 [N, M], cumulative
    value: np.ndarray  # float32 [N, Q, L]
    follows: np.ndarray  # int16 [S, Q, motions]
    cell: np.ndarray  # int16 [S, Q]
    walk: np.ndarray  # uint8 [S, Q, C]
    sees: np.ndarray  # bool [S, Q, C]
    pose: np.ndarray  # int16 [S, Q, 3]
    goals: np.ndarray  # int16 [S, G]
    moved: np.ndarray  # float64 [T, A, 2, 2]
    next_lost: np.ndarray  # int64 [D, L]
    judgement: np.ndarray  # float64 [D, 2, 2, N, L, 2, 2, 2, 2]
    shows: np.ndarray  # int32 [S, Q, 2 ** G], number of the code that a station shows, by the goals not to be seen


class Ways:
    """The nodes of one model, as one reading of persons' minds has them.

    Args:
        model: the learned model.
        codec: turns what stations show into codes.
        discount: per step, for V.
        slack: None where persons learn of a moved goal by seeing its place empty. Otherwise they are taken to know at
            once, but for this probability per step (`egocentric`).
    """

    def __init__(self, model: MindModel, codec: Codec, discount: float, slack: float | None = None) -> None:
        self.model, self.discount, self.slack = model, discount, slack
        scenes = model.scenes
        self.codes, shows = station_codes(model, codec)
        self.num_values = codec.num_values
        self.policy = model.policy
        self._follows = scenes.follows.tolist()
        self._cell = scenes.cell.tolist()
        self._sees = scenes.sees
        self._goals = scenes.goals.tolist()
        self._of: dict[Node, int] = {}
        self._nodes: list[Node] = []
        self._after: list[list[tuple[float, int]]] = []
        next_lost = model.lost_chance.argmax(-1).astype(np.int64)
        self.packed = PackedWays(
            np.zeros((0, 7), np.int64),
            np.zeros((0, _MOST), np.int64),
            np.zeros((0, _MOST)),
            np.zeros((0, scenes.pose.shape[1], model.num_lost), np.float32),
            scenes.follows,
            scenes.cell,
            scenes.walk,
            scenes.sees,
            scenes.pose,
            scenes.goals,
            model.moved_chance,
            next_lost,
            model.judgement,
            shows,
        )

    def constrain(self, possible: np.ndarray) -> None:
        """Take moves out of pi that rules exclude for what the person sees: bool [U, moves] for `codes`."""
        seen = possible[self.packed.shows[:, :, 0]][:, None]  # [S, 1, Q, moves]
        kept = self.policy.copy()
        kept[..., : possible.shape[1]] *= seen
        total = kept.sum(-1, keepdims=True)
        self.policy = np.where(total > 1e-12, kept / np.maximum(total, 1e-12), self.policy)

    def candidates(self, scene: int, gone: int = -1) -> list[int]:
        """The candidates of a scene, but for one that has vanished."""
        return [k for k, cell in enumerate(self._goals[scene]) if cell >= 0 and k != gone]

    def seen(self, scene: int, station: int, candidate: int) -> bool:
        """Whether a station shows a candidate's cell, or is on it."""
        cell = self._goals[scene][candidate]
        return bool(self._sees[scene, station, cell]) or self._cell[scene][station] == cell

    def successors(self, node: Node) -> dict[Node, float]:
        """All that may follow, however improbable."""
        s, t, p, z, g, gone, standing = node
        out: dict[Node, float] = {}
        goals = [(g, gone, 1.0)]
        if gone < 0:
            vanishes = self.model.vanish_chance(t, self.seen(s, p, g))
            others = self.candidates(s, g)
            if vanishes > 0 and others:
                goals = [(g, gone, 1.0 - vanishes), *((k, g, vanishes / len(others)) for k in others)]
        for own, left, share in goals:
            for heads, known in self._heads(z, own):
                weight = share * known
                chances = self.policy[s, heads, p]
                goal_cell = self._goals[s][own]
                for u in range(NUM_MOVES):
                    then = self._follows[s][p][u] if u != STAY else p
                    later = own if heads != own and self.seen(s, then, heads) else heads
                    stands = min(standing + 1, MAX_STANDING) if self._cell[s][then] == goal_cell else 0
                    after = (s, t + 1, then, later, own, left, stands)
                    out[after] = out.get(after, 0.0) + weight * float(chances[u])
        return out

    def _heads(self, z: int, own: int) -> list[tuple[int, float]]:
        if self.slack is None or z == own:
            return [(z, 1.0)]
        return [(own, 1.0 - self.slack), (z, self.slack)]

    def numbers(self, nodes: list[Node]) -> np.ndarray:
        """Numbers of nodes in the packed arrays; those that are new are made, with all that follows, and valued."""
        first = len(self._of)
        found = [self._make(node) for node in nodes]
        if len(self._of) > first:
            self._pack(first)
        return np.array(found, np.int64)

    def _make(self, node: Node) -> int:
        if node in self._of:
            return self._of[node]
        stack = [node]
        order: list[Node] = []
        while stack:
            here = stack.pop()
            if here in self._of:
                continue
            self._of[here] = len(self._of)
            order.append(here)
            self._nodes.append(here)
            self._after.append([])
            if here[CLOCK] >= self.model.horizon or here[STANDING] >= MAX_STANDING:
                continue
            likely = sorted(((c, after) for after, c in self.successors(here).items() if c >= _RARE), reverse=True)
            total = sum(c for c, _ in likely[:_MOST])
            self._after[-1] = [(c / total, after) for c, after in likely[:_MOST]]  # type: ignore[misc]
            stack.extend(after for _, after in likely[:_MOST])
        for here in order:
            number = self._of[here]
            self._after[number] = [(c, self._of[after]) for c, after in self._after[number]]  # type: ignore[index]
        return self._of[node]

    def _pack(self, first: int) -> None:
        """Add the nodes from `first` on to the packed arrays, and value them from the last step to the first."""
        fresh = self._nodes[first:]
        successor = np.full((len(fresh), _MOST), -1, np.int64)
        chance = np.ones((len(fresh), _MOST))
        for i in range(len(fresh)):
            total = 0.0
            for j, (c, after) in enumerate(self._after[first + i]):
                total += c
                successor[i, j], chance[i, j] = after, total
        used = first + len(fresh)
        if used > len(self.packed.node):
            self._grow(max(used, 2 * len(self.packed.node)))
        ways = self.packed
        ways.node[first:used] = np.array(fresh, np.int64)
        ways.successor[first:used] = successor
        ways.chance[first:used] = chance
        order = first + np.argsort(-ways.node[first:used, CLOCK], kind="stable")
        _value(ways, order, self.discount)

    def __len__(self) -> int:
        """Nodes; the packed arrays have room for more."""
        return len(self._of)

    def _grow(self, room: int) -> None:
        grown = {}
        for name in ("node", "successor", "chance", "value"):
            old = getattr(self.packed, name)
            grown[name] = np.zeros((room, *old.shape[1:]), old.dtype)
            grown[name][: len(old)] = old
        self.packed = self.packed._replace(**grown)


def station_codes(model: MindModel, codec: Codec) -> tuple[np.ndarray, np.ndarray]:
    """Distinct codes uint8 [U, N], and which of them each station shows: int32 [S, Q, 2 ** G].

    The last index has bit k set where candidate k is not to be seen: it has vanished, or somebody stands on it.
    """
    scenes = model.scenes
    count, most, width = scenes.pose.shape[0], scenes.pose.shape[1], scenes.view.shape[2]
    candidates = scenes.goals.shape[1]
    scene, station = np.nonzero(scenes.cell >= 0)
    views = np.zeros((count, most, 2**candidates, width, width), np.uint8)
    views[:] = scenes.view[:, :, None]
    for k in range(candidates):
        cell = scenes.goals[scene, k].astype(np.int64)
        shown = (cell >= 0) & scenes.sees[scene, station, cell]
        s, q = scene[shown], station[shown]
        vx, vy = scenes.place_in_view(s, q, cell[shown], width)
        hidden = np.flatnonzero(np.arange(2**candidates) >> k & 1)
        kind = views[s, q, 0, vx, vy]
        for mask in hidden:
            views[s, q, mask, vx, vy] = np.where(kind == GOAL, 0, kind)
    flat = views.reshape(-1, width * width)
    weights = 4 ** np.arange(width * width, dtype=np.uint64)
    _, first, index = np.unique((flat * weights).sum(1), return_index=True, return_inverse=True)
    codes, which = np.unique(codec.codes(flat[first].reshape(-1, width, width)), axis=0, return_inverse=True)
    return codes, which.reshape(-1)[index.reshape(-1)].reshape(views.shape[:3]).astype(np.int32)


@njit(cache=True)
def feature(
    ways: PackedWays, node: int, q: int, then: int, action: int, after: int
) -> tuple[int, int, int, int, int, int, int]:
    """What a step is judged by but for the lost counter: walk, sight, at goal, standing, enters, ahead, same place."""
    s = ways.node[after, 0]
    p = ways.node[after, 2]
    person_cell = ways.cell[s, p]
    cell = ways.cell[s, then]
    goal_cell = ways.goals[s, ways.node[after, 4]]
    walk = min(int(ways.walk[s, then, person_cell]), MAX_WALK)
    sight = 1 if ways.sees[s, then, person_cell] and cell != person_cell else 0
    at_goal = 1 if person_cell == goal_cell else 0
    enters = 1 if cell == goal_cell and then != q and action == FORWARD else 0
    faced = ways.follows[s, then, FORWARD]
    ahead = 1 if action == FORWARD and faced != then and ways.cell[s, faced] == person_cell else 0
    same = 1 if cell == person_cell else 0
    return walk, sight, at_goal, ways.node[after, 6], enters, ahead, same


@njit(cache=True)
def moved_chance(ways: PackedWays, node: int, q: int, action: int) -> float:
    """How probably an action moves the robot from a station."""
    s, t = ways.node[node, 0], ways.node[node, 1]
    faced = ways.follows[s, q, FORWARD]
    wall = 1 if action == FORWARD and faced == q else 0
    person = 1 if faced != q and ways.cell[s, faced] == ways.cell[s, ways.node[node, 2]] else 0
    while t >= ways.moved.shape[0]:
        t -= PERIOD
    return ways.moved[t, action, wall, person]


@njit(cache=True)
def _value(ways: PackedWays, order: np.ndarray, discount: float) -> None:
    num_lost = ways.value.shape[2]
    stations = ways.value.shape[1]
    q_value = np.zeros((4, num_lost))
    for i in order:
        s = ways.node[i, 0]
        for q in range(stations):
            if ways.cell[s, q] < 0:
                break
            for a in range(4):
                for k in range(num_lost):
                    q_value[a, k] = 0.0
                moves = moved_chance(ways, i, q, a) if a != STAY else 1.0
                for stays in range(2):
                    share = 1.0 - moves if stays == 1 else moves
                    if share < 0.01:
                        continue
                    then = q if stays == 1 else ways.follows[s, q, a]
                    below = 0.0
                    for m in range(ways.successor.shape[1]):
                        after = ways.successor[i, m]
                        if after < 0:
                            break
                        weight = share * (ways.chance[i, m] - below)
                        below = ways.chance[i, m]
                        walk, sight, at, stands, enters, ahead, same = feature(ways, i, q, then, a, after)
                        for k in range(num_lost):
                            judged = ways.judgement[walk, sight, at, stands, k, enters, ahead, same]
                            q_value[a, k] += weight * (
                                judged[0] + discount * judged[1] * ways.value[after, then, ways.next_lost[walk, k]]
                            )
            for k in range(num_lost):
                best = q_value[0, k]
                for a in range(1, 4):
                    best = max(best, q_value[a, k])
                ways.value[i, q, k] = best
