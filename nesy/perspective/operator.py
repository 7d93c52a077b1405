"""The perspective shift Φ(b, x^_a, M), and the influence modes.

Φ imagines to walk: it decodes the own view, plans a shortest way to the other agent's pose over what the view
shows, and rolls the belief through the learned forward model action by action. What is believed at the end is
b~_a, the belief of an agent that stands there (arXiv 2503.20425, section 3).

The planner `network` does just that with factored beliefs, as published. The planner `table` keeps the joint
distribution over codes and remembers what the own view has shown: after every step a code loses weight for every
cell that its decoded view has otherwise than the own view had it.

A belief that is certain of a code is shifted once per (code, configuration) and remembered. Walks from one belief
share their beginnings, so shifting one code to all configurations costs one step per pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from domains.core import UNSEEN
from nesy.checked_arrays import distributions, whole_numbers
from nesy.errors import UserError
from nesy.perspective.imagined_beliefs import Believed, JointRoll, roll_factored
from nesy.perspective.influence import InfluencePrior
from nesy.perspective.shortest_paths import Levels, Trees, levels, plan, poses_along
from nesy.world_model.codec import code_keys
from nesy.world_model.rolling import Rollout
from nesy.world_model.successors import Factored, PackedModel, pack

PLANNERS = ("table", "network")
BLOCK = 1024
"""Beliefs whose trees of walks are gone through at once, to bound the memory that their distributions take."""


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
        codes: uint8 [B, N], the most probable code of b~ (0 where not reachable).
    """

    beliefs: np.ndarray
    reachable: np.ndarray
    num_actions: np.ndarray
    codes: np.ndarray


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


class PerspectiveShift:
    """Φ over one model, with its memory."""

    def __init__(self, model: ShiftModel, planner: str = "table") -> None:
        """Prepare Φ.

        Args:
            model: codec or table model.
            planner: `table` rolls the joint distribution over codes through the 2DBN's tables and remembers what
                was seen; `network` rolls the factored belief through the model's `predict`, as published.

        Raises:
            UserError: an unknown planner, or `table` for a model that has no tables.
        """
        if planner not in PLANNERS:
            raise UserError(f"unknown planner '{planner}' of the perspective shift; known: {', '.join(PLANNERS)}")
        packed = model.packed() if planner == "table" else None
        if planner == "table" and packed is None:
            raise UserError("this world model has no tables; shift with planner 'network', or extract a 2DBN first")
        self.model = model
        self._joint = None if packed is None else JointRoll(packed, model)
        self._keys, self._place = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self._memory = _Walked.nowhere(0, model.num_factors, model.num_values)

    def __call__(self, beliefs: np.ndarray, configurations: np.ndarray) -> Shift:
        """Shift beliefs [B, N, K] to configurations [B].

        Raises:
            UserError: wrong shapes, no distributions, or no such configuration.
        """
        num_factors, num_values = self.model.num_factors, self.model.num_values
        beliefs = distributions(beliefs, "beliefs", (None, num_factors, num_values)).astype(np.float32)
        configurations = whole_numbers(configurations, "configurations", (len(beliefs),), 1 << 16).astype(np.int64)
        codes = beliefs.argmax(-1).astype(np.uint8)
        certain = (beliefs.max(-1) == 1.0).all(-1)
        result = _Walked.nowhere(len(beliefs), num_factors, num_values)
        rows = np.flatnonzero((configurations > 0) & certain)
        if len(rows):
            index = self._remembered(codes[rows], configurations[rows])
            result.put(rows, self._memory.take(index))
        rows = np.flatnonzero((configurations > 0) & ~certain)
        if len(rows):
            walked = self._walk(beliefs[rows], codes[rows], np.arange(len(rows)), configurations[rows])
            result.put(rows, walked)
        return Shift(result.beliefs, result.lengths >= 0, np.maximum(result.lengths, 0), result.codes)

    def prepare(self, codes: np.ndarray) -> int:
        """Shift certain beliefs in codes [C, N] to every configuration, to be remembered; returns how many pairs."""
        codes = np.asarray(codes, dtype=np.uint8)
        everywhere = np.arange(1, 4 * self.model.views(codes[:1])[0].size + 1)
        self._remembered(np.repeat(codes, len(everywhere), axis=0), np.tile(everywhere, len(codes)))
        return len(codes) * len(everywhere)

    def imagine(self, belief: np.ndarray, configuration: int) -> ImaginedPath:
        """One walk with every belief on the way; `belief` [N, K]."""
        belief = np.asarray(belief, dtype=np.float32)
        if configuration > 0:
            views = self.model.views(belief.argmax(-1).astype(np.uint8)[None])
            trees = plan(views)
            if trees.depth[0, configuration - 1] >= 0:
                poses, actions = trees.way(0, configuration - 1)
                nodes = levels(trees, np.zeros(len(poses), dtype=np.int64), np.array(poses))
                believed = self._roll(views, belief[None], trees, nodes)
                along = poses_along(poses, views.shape[1])
                return ImaginedPath(tuple(actions), believed.beliefs[nodes.targets], along, True)
        nowhere = np.full((1, *belief.shape), 1.0 / self.model.num_values, np.float32)
        return ImaginedPath((), nowhere, (), False)

    def _remembered(self, codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Index into the memory of each (code, configuration), which is filled where it has to be."""
        keys = code_keys(codes, self.model.num_values) << 16 | configurations
        index = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[index] == keys if len(self._keys) else np.zeros(len(keys), dtype=bool)
        if not known.all():
            new, first = np.unique(keys[~known], return_index=True)
            codes = codes[~known][first]
            _, root, row = np.unique(new >> 16, return_index=True, return_inverse=True)
            certain = np.eye(self.model.num_values, dtype=np.float32)[codes[root]]
            walked = self._walk(certain, codes[root], row, new & 0xFFFF)
            every = np.concatenate([self._keys, new])
            order = np.argsort(every, kind="stable")  # two sorted runs, which a stable sort merges
            self._keys = every[order]
            self._place = np.concatenate([self._place, len(self._place) + np.arange(len(new))])[order]
            self._memory = self._memory.joined(walked)
            index = np.searchsorted(self._keys, keys)
        return self._place[index]

    def _walk(self, beliefs: np.ndarray, codes: np.ndarray, rows: np.ndarray, configurations: np.ndarray) -> _Walked:
        """Walk from beliefs [R, N, K] with likeliest codes [R, N] to configurations [Q], all of them seen.

        `rows` int64 [Q], ascending, says from which belief; nothing is looked up.
        """
        result = _Walked.nowhere(len(rows), self.model.num_factors, self.model.num_values)
        for first in range(0, len(beliefs), BLOCK):
            block = slice(first, first + BLOCK)
            asked = np.arange(*np.searchsorted(rows, [first, first + BLOCK]))
            views = self.model.views(codes[block])
            trees = plan(views)
            row, pose = rows[asked] - first, configurations[asked] - 1
            whole_numbers(pose + 1, "configurations", (None,), trees.depth.shape[1] + 1)
            lengths = trees.depth[row, pose]
            reached = np.flatnonzero(lengths >= 0)
            if len(reached):
                nodes = levels(trees, row[reached], pose[reached])
                believed = self._roll(views, beliefs[block], trees, nodes)
                ends = (believed.beliefs[nodes.targets], lengths[reached], believed.codes[nodes.targets])
                result.put(asked[reached], _Walked(*ends))
        return result

    def _roll(self, views: np.ndarray, beliefs: np.ndarray, trees: Trees, nodes: Levels) -> Believed:
        if self._joint is None:
            return roll_factored(self.model, beliefs, trees, nodes)
        return self._joint(views, beliefs, trees, nodes)


@dataclass
class _Walked:
    """Results of walks: beliefs [n, N, K], path lengths [n] (-1: no way) and likeliest codes [n, N]."""

    beliefs: np.ndarray
    lengths: np.ndarray
    codes: np.ndarray

    @classmethod
    def nowhere(cls, size: int, num_factors: int, num_values: int) -> _Walked:
        uniform = np.full((size, num_factors, num_values), 1.0 / num_values, dtype=np.float32)
        return cls(uniform, np.full(size, -1, dtype=np.int64), np.zeros((size, num_factors), dtype=np.uint8))

    def put(self, rows: np.ndarray, other: _Walked) -> None:
        self.beliefs[rows], self.lengths[rows], self.codes[rows] = other.beliefs, other.lengths, other.codes

    def take(self, rows: np.ndarray) -> _Walked:
        return _Walked(self.beliefs[rows], self.lengths[rows], self.codes[rows])

    def joined(self, other: _Walked) -> _Walked:
        if not len(self.lengths):
            return other
        return _Walked(
            np.concatenate([self.beliefs, other.beliefs]),
            np.concatenate([self.lengths, other.lengths]),
            np.concatenate([self.codes, other.codes]),
        )


def shift(beliefs: np.ndarray, configurations: np.ndarray, model: ShiftModel, *, planner: str = "table") -> Shift:
    """Φ for a batch; keep a `PerspectiveShift` to remember shifts from call to call.

    Args:
        beliefs: float [B, N, K], the own beliefs; rows sum to 1.
        configurations: int [B], where the other agent is (0: unseen).
        model: codec or table model.
        planner: `table` or `network` (see `PerspectiveShift`).

    Raises:
        UserError: arrays of wrong shapes or values, or a planner that there is not.
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
    distributions(belief, "beliefs", (model.num_factors, model.num_values))
    if planner is None:
        planner = "network" if model.packed() is None else "table"
    return PerspectiveShift(model, planner).imagine(belief, int(configuration))


class InfluenceBelief:
    """b~ over the other agent's code, without memory, under an influence mode (table: nesy.perspective.influence).

    `zero` is uniform, and `random` a code of which each factor is drawn evenly; `perspective-shift` is Φ of the own
    belief, and `egocentric` the own belief. Under every mode b~ is uniform while the other agent is unseen, and where Φ
    finds no way to it: modes differ in what they make of an agent in view, not in when they have something to say.
    """

    def __init__(self, mode: str, codec: BeliefCodec, rng: np.random.Generator, *, even_unseen: bool = False) -> None:
        """Prepare a mode.

        Args:
            mode: one of `INFLUENCE_MODES`.
            codec: of the world model.
            rng: used by `random` alone.
            even_unseen: as in the publication, do not fall back to uniform where a mode needs no sight of the agent.

        Raises:
            UserError: an unknown mode.
        """
        self.prior, self.codec, self.even_unseen = InfluencePrior(mode, rng), codec, even_unseen
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
        nothing = np.full_like(beliefs, 1.0 / num_values)
        if self.prior.mode == "egocentric":
            believed = beliefs
        elif self.prior.mode == "perfect-information":
            if person_views is None:
                raise UserError("influence mode 'perfect-information' needs the other agent's true views")
            believed = np.asarray(self.codec.beliefs(person_views), dtype=np.float32)
        else:
            believed = self.prior.codes(beliefs.shape[:-1], num_values)
        if self.even_unseen:
            return believed.copy()
        return np.where((np.asarray(configurations) > 0)[:, None, None], believed, nothing)
