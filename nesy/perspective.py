"""The perspective shift Φ(b, x^_a, M), and the influence modes.

Φ imagines to walk: it decodes the own view, plans a shortest way to the other agent's pose over what the view
shows, and rolls the belief through the learned forward model action by action. What is believed at the end is
b~_a, the belief of an agent that stands there (arXiv 2503.20425, section 3).

A belief that is certain of a code is shifted once per (code, configuration) and remembered.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from domains.core import UNSEEN, WALL, ViewGeometry
from nesy.compiled import njit
from nesy.errors import UserError
from nesy.world_model.rolling import Rollout
from nesy.world_model.successors import Factored, PackedModel, pack

INFLUENCE_MODES = ("zero", "random", "egocentric", "perspective-shift", "perfect-information")
PLANNERS = ("table", "network")
LEFT, RIGHT, FORWARD = 0, 1, 2
UP = 3  # the viewer's own heading in view coordinates
_DX, _DY = (1, 0, -1, 0), (0, 1, 0, -1)


class ShiftModel(Protocol):
    """What Φ needs of a world model; `SymbolicCodec` and `TableModel` offer it."""

    num_factors: int
    num_values: int

    def views(self, codes: np.ndarray) -> np.ndarray:
        """Decoded views uint8 [B, v, v] of codes [B, N]."""
        ...

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Next beliefs [B, N, K] after actions [B]."""
        ...

    def packed(self) -> PackedModel | None:
        """The forward model's tables; None where it is no table."""
        ...


class BeliefCodec(ShiftModel, Protocol):
    """A `ShiftModel` that encodes too."""

    def beliefs(self, views: np.ndarray) -> np.ndarray:
        """Beliefs [B, N, K] of views [B, v, v]."""
        ...


class Tables(Factored, Protocol):
    """A 2DBN: structure and conditional tables."""

    @property
    def num_values(self) -> int:
        """K."""
        ...

    def cpt(self, action: int, factor: int) -> np.ndarray:
        """Conditional table [rows, K]."""
        ...


class TableModel:
    """An extracted 2DBN with the views its codes mean, for Φ without a network."""

    def __init__(self, dbn: Tables, codes: np.ndarray, views: np.ndarray) -> None:
        """Join a 2DBN and a code book.

        Args:
            dbn: the 2DBN.
            codes: uint8 [V, N].
            views: uint8 [V, v, v], what each code means.
        """
        num_actions, self.num_factors = len(dbn.parents_now), len(dbn.order)
        self.num_values = dbn.num_values
        tables = [[dbn.cpt(a, i) for i in range(self.num_factors)] for a in range(num_actions)]
        self._packed = pack(dbn, tables)
        self._rollout = Rollout(self._packed)
        keys = self._rollout.keys(codes)
        order = np.argsort(keys)
        self._keys, self._views = keys[order], views[order]

    def views(self, codes: np.ndarray) -> np.ndarray:
        """Views of codes [B, N]; UNSEEN throughout for a code that the code book does not hold."""
        keys = self._rollout.keys(np.asarray(codes))
        index = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        known = (self._keys[index] == keys)[:, None, None]
        return np.where(known, self._views[index], UNSEEN).astype(np.uint8)

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Next beliefs [B, N, K] after actions [B]."""
        start, code, mass = self._rollout.spread(np.asarray(beliefs, dtype=np.float64))
        start, code, mass = self._rollout.step(start, code, mass, np.asarray(actions, dtype=np.int64)[start])
        return self._rollout.marginals(start, code, mass, len(beliefs))

    def packed(self) -> PackedModel:
        """The tables."""
        return self._packed


class Shift(NamedTuple):
    """Shifted beliefs.

    Attributes:
        beliefs: float32 [B, N, K], b~; uniform where the other agent is unseen or out of reach.
        reachable: bool [B].
        num_actions: int64 [B], imagined actions; 0 where not reachable.
    """

    beliefs: np.ndarray
    reachable: np.ndarray
    num_actions: np.ndarray


class ImaginedPath(NamedTuple):
    """One imagined walk, for pictures.

    Attributes:
        actions: the L actions.
        beliefs: float32 [L + 1, N, K], before the first action and after each.
        poses: (vx, vy, heading) in view coordinates, L + 1 of them.
        reachable: whether there is such a walk; if not there is one belief, uniform, and no action.
    """

    actions: tuple[int, ...]
    beliefs: np.ndarray
    poses: tuple[tuple[int, int, int], ...]
    reachable: bool


@njit(cache=True)
def plan_path(view: np.ndarray, vx: int, vy: int, heading: int, path: np.ndarray) -> int:
    """A shortest way from the viewer's pose to a pose in its view; walls and unseen cells block.

    Uniform-cost search over (x, y, heading), actions tried in the order left, right, forward.

    Args:
        view: uint8 [v, v], indexed [vx, vy].
        vx: column of the pose.
        vy: row of the pose.
        heading: of the pose; the viewer's own is 3.
        path: int64 [at least 4 * v * v], gets the actions.

    Returns:
        The number of actions, or -1 if the pose cannot be reached.
    """
    width = view.shape[0]
    total = width * width * 4
    parent = np.full(total, -1, dtype=np.int64)
    action_to = np.zeros(total, dtype=np.int64)
    queue = np.zeros(total, dtype=np.int64)
    start = ((width // 2) * width + width - 1) * 4 + 3
    goal = (vx * width + vy) * 4 + heading
    parent[start] = start
    queue[0] = start
    head, tail = 0, 1
    while head < tail and parent[goal] < 0:
        pose = queue[head]
        head += 1
        h = pose % 4
        y = pose // 4 % width
        x = pose // 4 // width
        for action in range(3):
            nx, ny, nh = x, y, h
            if action == 0:
                nh = (h + 3) % 4
            elif action == 1:
                nh = (h + 1) % 4
            else:
                nx = x + (1 if h == 0 else -1 if h == 2 else 0)
                ny = y + (1 if h == 1 else -1 if h == 3 else 0)
                if nx < 0 or nx >= width or ny < 0 or ny >= width:
                    continue
                if view[nx, ny] == WALL or view[nx, ny] == UNSEEN:
                    continue
            then = (nx * width + ny) * 4 + nh
            if parent[then] < 0:
                parent[then] = pose
                action_to[then] = action
                queue[tail] = then
                tail += 1
    if parent[goal] < 0:
        return -1
    length = 0
    pose = goal
    while pose != start:
        path[length] = action_to[pose]
        length += 1
        pose = parent[pose]
    for i in range(length // 2):
        path[i], path[length - 1 - i] = path[length - 1 - i], path[i]
    return length


@njit(cache=True)
def _plan_all(views: np.ndarray, vx: np.ndarray, vy: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    paths = np.zeros((len(views), 4 * views.shape[1] * views.shape[2]), dtype=np.int64)
    lengths = np.zeros(len(views), dtype=np.int64)
    for i in range(len(views)):
        lengths[i] = plan_path(views[i], vx[i], vy[i], heading[i], paths[i])
    return paths, lengths


class PerspectiveShift:
    """Φ over one model, with its memory."""

    def __init__(self, model: ShiftModel, planner: str = "table") -> None:
        """Prepare Φ.

        Args:
            model: codec or table model.
            planner: `table` rolls the joint distribution over codes through the 2DBN's tables; `network` rolls
                the factored belief through the model's `predict`, as published.

        Raises:
            UserError: an unknown planner, or `table` for a model that has no tables.
        """
        if planner not in PLANNERS:
            raise UserError(f"unknown planner '{planner}' of the perspective shift; known: {', '.join(PLANNERS)}")
        packed = model.packed() if planner == "table" else None
        if planner == "table" and packed is None:
            raise UserError("this world model has no tables; shift with planner 'network', or extract a 2DBN first")
        self.model = model
        self._rollout = None if packed is None else Rollout(packed)
        self._keys = np.zeros(0, dtype=np.int64)
        self._beliefs = np.zeros((0, model.num_factors, model.num_values), dtype=np.float32)
        self._lengths = np.zeros(0, dtype=np.int64)

    def __call__(self, beliefs: np.ndarray, configurations: np.ndarray) -> Shift:
        """Shift beliefs [B, N, K] to configurations [B]."""
        beliefs = np.asarray(beliefs, dtype=np.float32)
        configurations = np.asarray(configurations, dtype=np.int64)
        num_factors, num_values = self.model.num_factors, self.model.num_values
        assert beliefs.shape == (len(configurations), num_factors, num_values), beliefs.shape
        codes = beliefs.argmax(-1).astype(np.uint8)
        certain = (beliefs.max(-1) == 1.0).all(-1)
        result = np.full_like(beliefs, 1.0 / num_values)
        lengths = np.full(len(beliefs), -1, dtype=np.int64)
        seen = configurations > 0
        rows = np.flatnonzero(seen & certain)
        if len(rows):
            index = self._remembered(codes[rows], configurations[rows])
            lengths[rows] = self._lengths[index]
            result[rows] = self._beliefs[index]
        rows = np.flatnonzero(seen & ~certain)
        if len(rows):
            result[rows], lengths[rows] = self._roll(beliefs[rows], codes[rows], configurations[rows])
        return Shift(result, lengths >= 0, np.maximum(lengths, 0))

    def _remembered(self, codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Index into the memory of each (code, configuration), which is filled where it has to be."""
        keys = np.zeros(len(codes), dtype=np.int64)
        for factor in range(codes.shape[1]):
            keys = keys * self.model.num_values + codes[:, factor]
        keys = keys << 16 | configurations
        index = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[index] == keys if len(self._keys) else np.zeros(len(keys), dtype=bool)
        if not known.all():
            new, first = np.unique(keys[~known], return_index=True)
            codes, configurations = codes[~known][first], configurations[~known][first]
            certain = np.eye(self.model.num_values, dtype=np.float32)[codes]
            beliefs, lengths = self._roll(certain, codes, configurations)
            merged = np.concatenate([self._keys, new])
            order = np.argsort(merged)
            self._keys = merged[order]
            self._beliefs = np.concatenate([self._beliefs, beliefs])[order]
            self._lengths = np.concatenate([self._lengths, lengths])[order]
            index = np.searchsorted(self._keys, keys)
        return index

    def _roll(
        self, beliefs: np.ndarray, codes: np.ndarray, configurations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Shifted beliefs and path lengths (-1: unreachable), nothing remembered."""
        views = self.model.views(codes)
        vx, vy, heading = ViewGeometry(views.shape[1]).decode(configurations)
        paths, lengths = _plan_all(views, vx, vy, heading)
        result = np.full_like(beliefs, 1.0 / self.model.num_values)
        result[lengths == 0] = beliefs[lengths == 0]
        # Longest first, so that the walks still under way are always the first ones.
        order = np.argsort(-lengths, kind="stable")
        order = order[: int((lengths > 0).sum())]
        if len(order):
            roll = self._roll_network if self._rollout is None else self._roll_tables
            result[order] = roll(beliefs[order], paths[order], lengths[order])
        return result, lengths

    def _roll_network(self, beliefs: np.ndarray, paths: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        beliefs = beliefs.copy()
        for step in range(int(lengths[0])):
            active = int((lengths > step).sum())
            beliefs[:active] = self.model.predict(beliefs[:active], paths[:active, step])
        return beliefs

    def _roll_tables(self, beliefs: np.ndarray, paths: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        assert self._rollout is not None
        result = np.empty_like(beliefs)
        block = 2048  # walks at once, to bound the memory of the sparse distributions
        for first in range(0, len(beliefs), block):
            rows = slice(first, min(first + block, len(beliefs)))
            start, code, mass = self._rollout.spread(beliefs[rows].astype(np.float64))
            active = lengths[rows]
            for step in range(int(active[0])):
                going = int((active > step).sum())
                # Starts ascend, so the entries of walks that have arrived are the last ones.
                cut = int(np.searchsorted(start, going))
                moved = self._rollout.step(start[:cut], code[:cut], mass[:cut], paths[rows][start[:cut], step])
                start, code, mass = (
                    np.concatenate([new, old[cut:]]) for new, old in zip(moved, (start, code, mass), strict=True)
                )
            result[rows] = self._rollout.marginals(start, code, mass, len(active))
        return result


def shift(beliefs: np.ndarray, configurations: np.ndarray, model: ShiftModel, *, planner: str = "table") -> Shift:
    """Φ for a batch; keep a `PerspectiveShift` to remember shifts from call to call.

    Args:
        beliefs: float [B, N, K], the own beliefs; rows sum to 1.
        configurations: int [B], where the other agent is (0: unseen).
        model: codec or table model.
        planner: `table` or `network` (see `PerspectiveShift`).
    """
    return PerspectiveShift(model, planner)(beliefs, configurations)


def imagine(belief: np.ndarray, configuration: int, model: ShiftModel, *, planner: str | None = None) -> ImaginedPath:
    """The walk that Φ imagines for one belief [N, K], with the belief after every step.

    Args:
        belief: float [N, K].
        configuration: where the other agent is.
        model: codec or table model.
        planner: as in `shift`; by default `table` where the model has tables.
    """
    belief = np.asarray(belief, dtype=np.float32)
    assert belief.shape == (model.num_factors, model.num_values), belief.shape
    packed = model.packed()
    nowhere = ImaginedPath((), np.full((1, *belief.shape), 1.0 / model.num_values, np.float32), (), False)
    if configuration <= 0:
        return nowhere
    view = model.views(belief.argmax(-1).astype(np.uint8)[None])[0]
    vx, vy, heading = (int(part) for part in ViewGeometry(len(view)).decode(configuration))
    path = np.zeros(4 * view.size, dtype=np.int64)
    length = plan_path(view, vx, vy, heading, path)
    if length < 0:
        return nowhere
    actions = tuple(int(action) for action in path[:length])
    beliefs = [belief]
    if packed is None or planner == "network":
        for action in actions:
            beliefs.append(model.predict(beliefs[-1][None], np.array([action]))[0])
    else:
        rollout = Rollout(packed)
        start, code, mass = rollout.spread(belief[None].astype(np.float64))
        for action in actions:
            start, code, mass = rollout.step(start, code, mass, np.full(len(start), action))
            beliefs.append(rollout.marginals(start, code, mass, 1)[0])
    return ImaginedPath(actions, np.stack(beliefs), _poses(actions, len(view)), True)


def _poses(actions: tuple[int, ...], width: int) -> tuple[tuple[int, int, int], ...]:
    x, y, heading = width // 2, width - 1, UP
    poses = [(x, y, heading)]
    for action in actions:
        if action == FORWARD:
            x, y = x + _DX[heading], y + _DY[heading]
        else:
            heading = (heading + (3 if action == LEFT else 1)) % 4
        poses.append((x, y, heading))
    return tuple(poses)


class InfluenceBelief:
    """What the planner takes the other agent to believe, under an influence mode.

    `zero`: nothing (uniform). `random`: a code drawn anew each time. `egocentric`: what the own agent believes.
    `perspective-shift`: Φ, uniform where the other agent is unseen or out of reach. `perfect-information`: the
    code of the other agent's true view.
    """

    def __init__(self, mode: str, codec: BeliefCodec, rng: np.random.Generator) -> None:
        """Prepare a mode.

        Args:
            mode: one of `INFLUENCE_MODES`.
            codec: of the world model.
            rng: used by `random` alone.

        Raises:
            UserError: an unknown mode.
        """
        if mode not in INFLUENCE_MODES:
            raise UserError(f"unknown influence mode '{mode}'; known: {', '.join(INFLUENCE_MODES)}")
        self.mode, self.codec, self.rng = mode, codec, rng
        self._shift: PerspectiveShift | None = None
        if mode == "perspective-shift":
            self._shift = PerspectiveShift(codec, "network" if codec.packed() is None else "table")

    def __call__(
        self, beliefs: np.ndarray, configurations: np.ndarray, person_views: np.ndarray | None = None
    ) -> np.ndarray:
        """b~ float32 [B, N, K] for own beliefs [B, N, K], configurations [B] and, for `perfect-information`
        alone, the true views [B, v, v].
        """  # noqa: D205
        beliefs = np.asarray(beliefs, dtype=np.float32)
        num_values = beliefs.shape[-1]
        if self._shift is not None:
            return self._shift(beliefs, configurations).beliefs
        if self.mode == "egocentric":
            return beliefs.copy()
        if self.mode == "perfect-information":
            if person_views is None:
                raise UserError("influence mode 'perfect-information' needs the other agent's true views")
            return np.asarray(self.codec.beliefs(person_views), dtype=np.float32)
        if self.mode == "random":
            codes = self.rng.integers(0, num_values, beliefs.shape[:-1])
            return np.eye(num_values, dtype=np.float32)[codes]
        return np.full_like(beliefs, 1.0 / num_values)
