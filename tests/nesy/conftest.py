"""A toy world small enough to check by hand, and a world model trained on it once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from domains.core import Symmetry
from nesy.config import TrainConfig
from nesy.log.experience import Experience
from nesy.world_model import SymbolicCodec, load_world_model, train

SYMMETRIES = (Symmetry("mirror image", (1, 0, 2, 3), lambda views: views[:, ::-1]),)
"""Of the toy world."""
SMALL = TrainConfig(epochs=6, batch_size=64, held_out=0.25, time_limit=0.0)


def views_along(corridor: np.ndarray) -> np.ndarray:
    """uint8 [L, 5, 5]: what is seen at every place of a corridor given as wall bits beside it."""
    views = np.zeros((len(corridor), 5, 5), dtype=np.uint8)
    for place in range(len(corridor)):
        for ahead in range(5):
            index = place + ahead
            views[place, [0, 4], 4 - ahead] = 1
            views[place, 1, 4 - ahead] = corridor[index] if index < len(corridor) else 1
            views[place, 3, 4 - ahead] = 0 if index < len(corridor) else 1
            views[place, 2, 4 - ahead] = 0 if index < len(corridor) else 1
    return views


def toy_experience(seed: int = 0, steps: int = 1500) -> Experience:
    """Walks in corridors: forward goes on, left and right lead back to the start, stay does nothing."""
    rng = np.random.default_rng(seed)
    corridors = [views_along(rng.integers(0, 2, 7)) for _ in range(4)]
    corridors += [views[:, ::-1] for views in corridors]  # the world has no handedness
    rows: dict[str, list[np.ndarray | int]] = {"view": [], "next_view": [], "action": [], "map_id": []}
    place, which = 0, 0
    for _ in range(steps):
        views = corridors[which]
        action = int(rng.integers(4))
        then = 0 if action < 2 else min(place + 1, 6) if action == 2 else place
        rows["view"].append(views[place])
        rows["next_view"].append(views[then])
        rows["action"].append(action)
        rows["map_id"].append(which)
        place = then
        if rng.random() < 0.1:
            place, which = 0, int(rng.integers(8))
    count = steps
    views, next_views = np.array(rows["view"]), np.array(rows["next_view"])

    def zeros(dtype: type, *shape: int) -> np.ndarray:
        return np.zeros((count, *shape), dtype=dtype)

    return Experience(
        episode=zeros(np.int64), t=zeros(np.int32), source=np.array(["crossing-random"] * count),
        map_id=np.array(rows["map_id"], dtype=np.int64), view=views, configuration=zeros(np.int16),
        relative_pose=zeros(np.int16, 3), waiting=zeros(np.int16), lost=zeros(np.int16), person_view=views,
        action=np.array(rows["action"], dtype=np.int8), person_action=zeros(np.int8), reward=zeros(np.float32),
        terminated=zeros(np.bool_), truncated=zeros(np.bool_), outcome=zeros(np.int8),
        distance=zeros(np.float32), visible=zeros(np.bool_), next_view=next_views,
        next_configuration=zeros(np.int16), next_relative_pose=zeros(np.int16, 3), next_person_view=next_views,
    )  # fmt: skip


@pytest.fixture(scope="session")
def toy() -> Experience:
    return toy_experience()


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, toy: Experience) -> Path:
    """Folder of a model trained on the toy world."""
    folder = tmp_path_factory.mktemp("toy") / "world_model"
    train(toy, SMALL, folder, seed=1, symmetries=SYMMETRIES)
    return folder


@pytest.fixture(scope="session")
def codec(trained: Path) -> SymbolicCodec:
    return SymbolicCodec(load_world_model(trained))
