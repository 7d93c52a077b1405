"""The perspective shift Φ(b, x^_a, M), and the influence modes.

Φ imagines to walk: it decodes the own view, plans a shortest way to the other agent's pose over what the view
shows, and rolls the belief through the learned forward model action by action. What is believed at the end is
b~_a, the belief of an agent that stands there (arXiv 2503.20425, section 3).

The planner `network` does just that with factored beliefs, as published. The planner `table` keeps the joint
distribution over codes and remembers what the own view has shown: after every step a code loses weight for every
cell that its decoded view has otherwise than the own view had it.

A belief that is certain of a code is shifted once per (code, configuration) and remembered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from domains.core import UNSEEN, ViewGeometry
from nesy.errors import UserError
from nesy.world_model.codec import code_keys
from nesy.world_model.rolling import Rollout
from nesy.world_model.successors import Factored, PackedModel, pack
from nesy.world_model.walks import plan_all, poses_along, remember_all

INFLUENCE_MODES = ("zero", "random", "egocentric", "perspective-shift", "perfect-information")
PLANNERS = ("table", "network")
FORGET = 0.01
"""Weight that a code keeps for every cell in which it contradicts what was seen."""
BLOCK = 2048
"""Walks rolled at once, to bound the memory that their sparse distributions take."""


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
        self._rollout = None if packed is None else Rollout(packed)
        self._keys = np.zeros(0, dtype=np.int64)
        self._memory = _Walked.nowhere(0, model.num_factors, model.num_values)

    def __call__(self, beliefs: np.ndarray, configurations: np.ndarray) -> Shift:
        """Shift beliefs [B, N, K] to configurations [B]."""
        beliefs = np.asarray(beliefs, dtype=np.float32)
        configurations = np.asarray(configurations, dtype=np.int64)
        num_factors, num_values = self.model.num_factors, self.model.num_values
        assert beliefs.shape == (len(configurations), num_factors, num_values), beliefs.shape
        codes = beliefs.argmax(-1).astype(np.uint8)
        certain = (beliefs.max(-1) == 1.0).all(-1)
        result = _Walked.nowhere(len(beliefs), num_factors, num_values)
        rows = np.flatnonzero((configurations > 0) & certain)
        if len(rows):
            index = self._remembered(codes[rows], configurations[rows])
            result.put(rows, self._memory.take(index))
        rows = np.flatnonzero((configurations > 0) & ~certain)
        if len(rows):
            result.put(rows, self._walk(beliefs[rows], codes[rows], configurations[rows]))
        return Shift(result.beliefs, result.lengths >= 0, np.maximum(result.lengths, 0), result.codes)

    def imagine(self, belief: np.ndarray, configuration: int) -> ImaginedPath:
        """One walk with every belief on the way; `belief` [N, K]."""
        belief = np.asarray(belief, dtype=np.float32)
        nowhere = ImaginedPath((), np.full((1, *belief.shape), 1.0 / self.model.num_values, np.float32), (), False)
        if configuration <= 0:
            return nowhere
        views = self.model.views(belief.argmax(-1).astype(np.uint8)[None])
        paths, lengths = plan_all(views, *self._targets(views, np.array([configuration])))
        if lengths[0] < 0:
            return nowhere
        beliefs = [belief]
        if lengths[0] > 0:
            self._roll(belief[None], views, paths, lengths, beliefs)
        actions = tuple(int(action) for action in paths[0, : lengths[0]])
        return ImaginedPath(actions, np.stack(beliefs), poses_along(actions, views.shape[1]), True)

    @staticmethod
    def _targets(views: np.ndarray, configurations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return ViewGeometry(views.shape[1]).decode(configurations)

    def _remembered(self, codes: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """Index into the memory of each (code, configuration), which is filled where it has to be."""
        keys = code_keys(codes, self.model.num_values) << 16 | configurations
        index = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[index] == keys if len(self._keys) else np.zeros(len(keys), dtype=bool)
        if not known.all():
            new, first = np.unique(keys[~known], return_index=True)
            codes, configurations = codes[~known][first], configurations[~known][first]
            walked = self._walk(np.eye(self.model.num_values, dtype=np.float32)[codes], codes, configurations)
            order = np.argsort(np.concatenate([self._keys, new]))
            self._keys = np.concatenate([self._keys, new])[order]
            self._memory = self._memory.joined(walked).take(order)
            index = np.searchsorted(self._keys, keys)
        return index

    def _walk(self, beliefs: np.ndarray, codes: np.ndarray, configurations: np.ndarray) -> _Walked:
        """Walk to configurations, all of them seen; nothing is looked up."""
        views = self.model.views(codes)
        paths, lengths = plan_all(views, *self._targets(views, configurations))
        result = _Walked.nowhere(len(beliefs), self.model.num_factors, self.model.num_values)
        result.lengths[:] = lengths
        here = np.flatnonzero(lengths == 0)
        result.put(here, _Walked(beliefs[here], lengths[here], codes[here]))
        # Longest first, so that the walks still under way are always the first ones.
        order = np.argsort(-lengths, kind="stable")[: int((lengths > 0).sum())]
        for first in range(0, len(order), BLOCK):
            rows = order[first : first + BLOCK]
            shifted, likeliest = self._roll(beliefs[rows], views[rows], paths[rows], lengths[rows])
            result.put(rows, _Walked(shifted, lengths[rows], likeliest))
        return result

    def _roll(
        self,
        beliefs: np.ndarray,
        views: np.ndarray,
        paths: np.ndarray,
        lengths: np.ndarray,
        trace: list[np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Beliefs and likeliest codes at the ends of walks, longest walk first; `trace` gets those of the first."""
        if self._rollout is None:
            beliefs = beliefs.copy()
            for step in range(int(lengths[0])):
                going = int((lengths > step).sum())
                beliefs[:going] = self.model.predict(beliefs[:going], paths[:going, step])
                if trace is not None:
                    trace.append(beliefs[0].copy())
            return beliefs, beliefs.argmax(-1).astype(np.uint8)
        rollout = self._rollout
        memory = remember_all(views, paths, lengths)
        start, code, mass = rollout.spread(beliefs.astype(np.float64))
        for step in range(int(lengths[0])):
            going = int((lengths > step).sum())
            # Starts ascend, so the entries of walks that have arrived are the last ones.
            cut = int(np.searchsorted(start, going))
            moved = rollout.step(start[:cut], code[:cut], mass[:cut], paths[start[:cut], step])
            moved = self._reminded(rollout, *moved, memory[:going, step])
            rest = (start[cut:], code[cut:], mass[cut:])
            start, code, mass = (np.concatenate([new, old]) for new, old in zip(moved, rest, strict=True))
            if trace is not None:
                trace.append(rollout.marginals(start, code, mass, len(beliefs))[0])
        best = np.lexsort((-mass, start))[np.searchsorted(start, np.arange(len(beliefs)))]
        return rollout.marginals(start, code, mass, len(beliefs)), rollout.codes(code[best])

    def _reminded(
        self, rollout: Rollout, start: np.ndarray, code: np.ndarray, mass: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weigh the codes of walks by how well their views agree with what was seen, `memory` [walks, v, v]."""
        distinct, place = np.unique(code, return_inverse=True)
        meant = self.model.views(rollout.codes(distinct)).reshape(len(distinct), -1)
        seen = memory.reshape(len(memory), -1)[start]
        wrong = ((meant[place] != seen) & (seen != UNSEEN)).sum(1)
        least = np.full(len(memory), seen.shape[1])
        np.minimum.at(least, start, wrong)
        weighed = mass * FORGET ** (wrong - least[start]).astype(np.float64)
        return rollout.pruned(start, code, weighed)


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
    assert np.shape(belief) == (model.num_factors, model.num_values), np.shape(belief)
    if planner is None:
        planner = "network" if model.packed() is None else "table"
    return PerspectiveShift(model, planner).imagine(belief, int(configuration))


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
