"""Gates of the `symbolic` architecture while its network is trained, when there are no tables yet.

The forward guide takes their place: the likelihood of the next code, and the likeliest one, factor after factor.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import Transitions
from nesy.world_model.gates import infer_actions, view_gates
from nesy.world_model.imagination import HORIZONS, starts_of


class Guide(Protocol):
    """Predicts the next code factor by factor, later factors seeing the earlier ones."""

    def __call__(self, belief: Tensor, action: Tensor, then: Tensor) -> Tensor:
        """Logits [B, N, K] of the next code, given what followed in earlier factors, `then` [B, N, K]."""
        ...


def guided_gates(
    codec: SymbolicCodec,
    guide: Guide,
    held_out: Transitions,
    columns: Columns,
    maps: np.ndarray,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """The gates on held-out maps, with the guide as the forward model.

    Args:
        codec: of the network as it is now.
        guide: trained with it.
        held_out: the transitions of those maps.
        columns: all steps, for imagined walks.
        maps: bool [M], which maps are held out.
        rng: draws where the imagined walks begin.

    Returns:
        As `gates.view_gates` and `gates.next_gates`, and `rollouts` as `imagination.imagined_rollouts`.
    """
    t, weight = held_out, held_out.weight.astype(np.float64)
    codes = codec.codes(t.views)
    device = codec.model.device()
    with torch.no_grad():
        before, then = (torch.as_tensor(codec.certain(codes[ends]), device=device) for ends in (t.source, t.target))
        logits = guide(before, torch.as_tensor(t.action, device=device), then)
        nll = -(F.log_softmax(logits, -1) * then).sum((1, 2)).double().cpu().numpy()
    context, place = np.unique(t.source * 4 + t.action, return_inverse=True)
    predicted = _likeliest(codec, guide, codes[context // 4], context % 4)
    same = (codec.views(predicted)[place] == t.views[t.target]).reshape(len(t), -1)
    inferred = infer_actions(codec, codes[t.source], codes[t.target])
    total = weight.sum()
    return {
        **view_gates(codec, t.views),
        "next_code_nll": float((weight * nll).sum() / total),
        "next_view_exact": float((weight * same.all(1)).sum() / total),
        "next_view_cells": float((weight * same.mean(1)).sum() / total),
        "inverse_accuracy": float((weight * (inferred == t.action)).sum() / total),
        "rollouts": _rollouts(codec, guide, columns, starts_of(columns, HORIZONS[-1], 200, rng, maps)),
    }


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
