"""The world model for everybody else: NumPy in, NumPy out, memoised by view and by code."""

from __future__ import annotations

import numpy as np
import torch

from domains.core import CELL_KINDS
from nesy.checked_arrays import distributions, whole_numbers
from nesy.world_model.distinct import view_keys
from nesy.world_model.networks import SymbolicWorldModel, WorldModel
from nesy.world_model.successors import PackedModel, pack

CHUNK = 4096


class _Memo:
    """Rows by key, grown in sorted order."""

    def __init__(self) -> None:
        self.keys: np.ndarray | None = None
        self.rows: np.ndarray | None = None

    def find(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Index into `rows` of each key, and whether it is there."""
        if self.keys is None:
            return np.zeros(len(keys), np.int64), np.zeros(len(keys), bool)
        index = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return index, self.keys[index] == keys

    def add(self, keys: np.ndarray, rows: np.ndarray) -> None:
        """Add new distinct keys, in ascending order."""
        if self.keys is None or self.rows is None:
            self.keys, self.rows = keys, rows
            return
        keys, rows = np.concatenate([self.keys, keys]), np.concatenate([self.rows, rows])
        order = np.argsort(keys, kind="stable")  # two sorted runs, which a stable sort merges
        self.keys, self.rows = keys[order], rows[order]


def code_keys(codes: np.ndarray, num_values: int) -> np.ndarray:
    """The code [.., N] as one number, first factor most significant: int64 [..]."""
    key = np.zeros(codes.shape[:-1], dtype=np.int64)
    for factor in range(codes.shape[-1]):
        key = key * num_values + codes[..., factor]
    return key


class SymbolicCodec:
    """Views to codes and back, and belief prediction, with the network asked once per distinct view or code."""

    def __init__(self, model: WorldModel) -> None:
        self.model = model.eval()
        self.num_factors, self.num_values = model.num_factors, model.num_values
        self.num_actions, self.view_size = model.num_actions, model.view_size
        self._codes_of, self._views_of = _Memo(), _Memo()
        self._packed: PackedModel | None = None

    def codes(self, views: np.ndarray) -> np.ndarray:
        """Codes uint8 [B, N] of views uint8 [B, v, v]."""
        views = self._checked(views)
        keys = view_keys(views)
        _, known = self._codes_of.find(keys)
        if not known.all():
            new, first = np.unique(keys[~known], return_index=True)
            self._codes_of.add(new, self._encode(views[~known][first]))
        index, _ = self._codes_of.find(keys)
        if self._codes_of.rows is None:
            return np.zeros((0, self.num_factors), np.uint8)
        return self._codes_of.rows[index]

    def beliefs(self, views: np.ndarray) -> np.ndarray:
        """Beliefs float32 [B, N, K], certain of the views' codes."""
        return self.certain(self.codes(views))

    def certain(self, codes: np.ndarray) -> np.ndarray:
        """Beliefs float32 [B, N, K] that are certain of codes [B, N]."""
        codes = whole_numbers(codes, "codes", (None, self.num_factors), self.num_values)
        return np.eye(self.num_values, dtype=np.float32)[codes]

    def views(self, codes: np.ndarray) -> np.ndarray:
        """Views uint8 [B, v, v] that codes [B, N] mean: the most probable kind of every cell."""
        codes = whole_numbers(codes, "codes", (None, self.num_factors), self.num_values).astype(np.uint8)
        keys = code_keys(codes, self.num_values)
        _, known = self._views_of.find(keys)
        if not known.all():
            new, first = np.unique(keys[~known], return_index=True)
            self._views_of.add(new, self._decode(self.certain(codes[~known][first])))
        index, _ = self._views_of.find(keys)
        if self._views_of.rows is None:
            return np.zeros((0, self.view_size, self.view_size), np.uint8)
        return self._views_of.rows[index]

    def predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Next beliefs float32 [B, N, K] after actions [B], by the network's transition.

        Where all beliefs are certain, each distinct pair of a code and an action is asked once.
        """
        beliefs = distributions(beliefs, "beliefs", (None, self.num_factors, self.num_values)).astype(np.float32)
        actions = whole_numbers(actions, "actions", (len(beliefs),), self.num_actions).astype(np.int64)
        if len(beliefs) < 2 or not (beliefs.max(-1) == 1).all():
            return self._predict(beliefs, actions)
        keys = code_keys(beliefs.argmax(-1), self.num_values) * self.num_actions + actions
        _, first, place = np.unique(keys, return_index=True, return_inverse=True)
        return self._predict(beliefs[first], actions[first])[place]

    def _predict(self, beliefs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        device = self.model.device()
        with torch.no_grad():
            parts = [
                self.model.transition(
                    torch.as_tensor(beliefs[first : first + CHUNK], device=device),
                    torch.as_tensor(actions[first : first + CHUNK], device=device),
                ).cpu()
                for first in range(0, len(beliefs), CHUNK)
            ]
        if not parts:
            return np.zeros_like(beliefs)
        return np.concatenate([part.numpy() for part in parts]).astype(np.float32)

    def packed(self) -> PackedModel | None:
        """The forward model's tables for compiled loops; None where the forward model is no table."""
        if self._packed is None and isinstance(self.model, SymbolicWorldModel):
            self._packed = pack(self.model.structure(), self.model.tables())
        return self._packed

    def _checked(self, views: np.ndarray) -> np.ndarray:
        shape = (None, self.view_size, self.view_size)
        return whole_numbers(views, "views", shape, len(CELL_KINDS)).astype(np.uint8)

    def _encode(self, views: np.ndarray) -> np.ndarray:
        device = self.model.device()
        with torch.no_grad():
            parts = [
                self.model.codes(torch.as_tensor(views[first : first + CHUNK], device=device)).cpu().numpy()
                for first in range(0, len(views), CHUNK)
            ]
        return np.concatenate(parts).astype(np.uint8)

    def _decode(self, beliefs: np.ndarray) -> np.ndarray:
        device = self.model.device()
        with torch.no_grad():
            parts = [
                self.model.decode(torch.as_tensor(beliefs[first : first + CHUNK], device=device)).argmax(-1).cpu()
                for first in range(0, len(beliefs), CHUNK)
            ]
        return np.concatenate([part.numpy() for part in parts]).astype(np.uint8)
