import dataclasses

import numpy as np

from nesy.log.experience import Experience
from nesy.world_model import SymbolicCodec
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import free_ahead
from nesy.world_model.training.imagination import imagined_rollouts, starts_of


def episodes_of(toy: Experience, length: int) -> Columns:
    return Columns.of(dataclasses.replace(toy, episode=np.arange(len(toy)) // length))


def test_starts_stay_inside_episodes_and_off_blocked_steps(toy: Experience) -> None:
    cut = episodes_of(toy, 10)
    rows = starts_of(cut, 8, 10**6, np.random.default_rng(0))
    assert set(rows % 10) == {0, 1, 2}
    configuration = np.zeros(len(toy), dtype=np.int16)
    configuration[15] = 1 + (2 * 5 + 3) * 4
    free = dataclasses.replace(cut, free=free_ahead(configuration, 5))
    rows = starts_of(free, 8, 10**6, np.random.default_rng(0))
    assert not set(rows) & {10, 11, 12}
    assert len(starts_of(episodes_of(toy, 5), 8, 10, np.random.default_rng(0))) == 0


def test_staying_is_foreseen_for_ever(codec: SymbolicCodec, toy: Experience) -> None:
    """A world in which nothing happens is foreseen exactly at every horizon."""
    view = np.repeat(toy.view[::16][:50], 8, axis=0)
    rows = toy.select(np.arange(len(view)))
    still = dataclasses.replace(
        rows, view=view, next_view=view, action=np.full(len(view), 3, np.int8), episode=np.arange(len(view)) // 8
    )
    figures = imagined_rollouts(codec, Columns.of(still), np.random.default_rng(0))
    assert figures == {str(h): {"exact": 1.0, "cells": 1.0} for h in (1, 2, 4, 8)}
    wrong = dataclasses.replace(still, next_view=1 - np.minimum(view, 1))
    assert imagined_rollouts(codec, Columns.of(wrong), np.random.default_rng(0))["1"]["cells"] == 0.0
