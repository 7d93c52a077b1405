"""The gates on maps that are held out, after every epoch of a training.

While the network of the `symbolic` architecture is trained by gradients alone there are no tables yet. The forward
guide takes their place: the likelihood of the next code, and the likeliest one, factor after factor.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from domains.core import Weighting
from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.codes.refinement import CodeBook
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import Transitions, view_keys
from nesy.world_model.training.gates import book_nll, evaluate, infer_actions, view_gates
from nesy.world_model.training.imagination import HORIZONS, imagined_rollouts, starts_of


class Guide(Protocol):
    """Predicts the next code factor by factor, later factors seeing the earlier ones."""

    def __call__(self, belief: Tensor, action: Tensor, then: Tensor) -> Tensor:
        """Logits [B, N, K] of the next code, given what followed in earlier factors, `then` [B, N, K]."""
        ...


class HeldOut:
    """What was met on the maps that nothing is learned from."""

    def __init__(
        self, columns: Columns, maps: np.ndarray, training: Transitions, seed: int, weighting: Weighting = "visits"
    ) -> None:
        """Gather it.

        Args:
            columns: all steps.
            maps: bool [M], which maps are held out.
            training: what is learned from: tells which views are new.
            seed: of where imagined walks begin.
            weighting: what a transition counts as.
        """
        self.columns, self.maps, self.training, self.seed = columns, maps, training, seed
        self.transitions = columns.transitions(maps, weighting=weighting)
        keys = view_keys(self.transitions.views)
        self.new = ~np.isin(keys, view_keys(training.views[training.visits > 0]))
        self._place = np.searchsorted(view_keys(training.views), keys)

    def gates(self, codec: SymbolicCodec) -> dict[str, Any]:
        """As `gates.evaluate`; `rollouts` as `imagination.imagined_rollouts`; figures of views met nowhere else."""
        rng = np.random.default_rng(self.seed)
        rollouts = imagined_rollouts(codec, self.columns, rng, maps=self.maps)
        return {**evaluate(codec, self.transitions), "rollouts": rollouts, **self._of_new_views(codec)}

    def nll(self, book: CodeBook, num_values: int) -> float:
        """Nats of the next code here, under tables counted from what is learned from."""
        return book_nll(book, self.training, self.transitions, self._place, num_values)

    def guided(self, codec: SymbolicCodec, guide: Guide) -> dict[str, Any]:
        """As `gates`, with the guide trained beside `codec` as the forward model."""
        t, weight = self.transitions, self.transitions.weight.astype(np.float64)
        codes = codec.codes(t.views)
        device = codec.model.device()
        with torch.no_grad():
            before, then = (torch.as_tensor(codec.certain(codes[ends]), device=device) for ends in (t.source, t.target))
            logits = guide(before, torch.as_tensor(t.action, device=device), then)
            nll = -(F.log_softmax(logits, -1) * then).sum((1, 2)).double().cpu().numpy()
        context, place = np.unique(t.source * t.num_actions + t.action, return_inverse=True)
        predicted = _likeliest(codec, guide, codes[context // t.num_actions], context % t.num_actions)
        same = (codec.views(predicted)[place] == t.views[t.target]).reshape(len(t), -1)
        inferred = infer_actions(codec, codes[t.source], codes[t.target])
        total = weight.sum()
        rows = starts_of(self.columns, HORIZONS[-1], 200, np.random.default_rng(self.seed), self.maps)
        return {
            **view_gates(codec, t.views),
            "next_code_nll": float((weight * nll).sum() / total),
            "next_view_exact": float((weight * same.all(1)).sum() / total),
            "next_view_cells": float((weight * same.mean(1)).sum() / total),
            "inverse_accuracy": float((weight * (inferred == t.action)).sum() / total),
            "rollouts": _rollouts(codec, guide, self.columns, rows),
            **self._of_new_views(codec),
        }

    def _of_new_views(self, codec: SymbolicCodec) -> dict[str, Any]:
        figures: dict[str, Any] = {"new_views": int(self.new.sum())}
        if self.new.any():
            found = view_gates(codec, self.transitions.views[self.new])
            figures |= {f"new_{name}": found[name] for name in ("views_exact", "cells")}
        return figures


def _likeliest(codec: SymbolicCodec, guide: Guide, codes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Next codes uint8 [B, N], every factor the likeliest given the ones before it."""
    device = codec.model.device()
    with torch.no_grad():
        belief = torch.as_tensor(codec.certain(codes), device=device)
        action = torch.as_tensor(np.asarray(actions, dtype=np.int64), device=device)
        then = torch.zeros_like(belief)
        for factor in range(codec.num_factors):
            value = guide(belief, action, then)[:, factor].argmax(-1)
            then[:, factor] = F.one_hot(value, codec.num_values).to(then.dtype)
        return np.asarray(then.argmax(-1).cpu().numpy(), dtype=np.uint8)


def _rollouts(codec: SymbolicCodec, guide: Guide, columns: Columns, rows: np.ndarray) -> dict[str, dict[str, float]]:
    if not len(rows):
        return {}
    codes = codec.codes(columns.views[columns.source[rows]])
    figures = {}
    for step in range(HORIZONS[-1]):
        codes = _likeliest(codec, guide, codes, columns.action[rows + step])
        if step + 1 in HORIZONS:
            right = (codec.views(codes) == columns.views[columns.target[rows + step]]).reshape(len(rows), -1)
            figures[str(step + 1)] = {"exact": float(right.all(1).mean()), "cells": float(right.mean())}
    return figures
