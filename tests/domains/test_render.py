"""Pictures: Minigrid's own where there is nothing of ours in them, and the person where it stands."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from minigrid.core.world_object import Wall
from minigrid.envs.crossing import CrossingEnv

from domains import DomainError


def test_crossing_looks_like_minigrid():
    original = CrossingEnv(size=9, num_crossings=2, obstacle_type=Wall, agent_view_size=5, render_mode="rgb_array")
    env = gymnasium.make("nesy/Crossing-v0", num_crossings=2, see_through_walls=False, render_mode="rgb_array")
    original.reset(seed=3)
    env.reset(seed=3)
    for action in (2, 1, 2, 0, 2, 2):
        original.step(action)
        env.step(action)
        assert (original.get_frame(tile_size=32) == env.render()).all()


@pytest.mark.parametrize("heading_action", [0, 1])
def test_person_is_drawn_where_it_stands_and_looks(heading_action):
    env = gymnasium.make("nesy/PersonFollowing-v0", render_mode="rgb_array", look_back=False)
    env.reset(seed=0)
    for _ in range(4):
        picture = env.render()
        x, y, heading = env.unwrapped.state()["person"]
        tile = picture[y * 32 : y * 32 + 32, x * 32 : x * 32 + 32].astype(int)
        blue = (tile[..., 2] > 200) & (tile[..., 0] < 60)
        assert blue.sum() > 100
        # The triangle points forward: its mass lies behind the middle of the tile.
        rows, columns = np.nonzero(blue)
        behind = {0: columns.mean() < 15.5, 1: rows.mean() < 15.5, 2: columns.mean() > 15.5, 3: rows.mean() > 15.5}
        assert behind[heading]
        env.step(heading_action)


def test_unknown_mode_is_refused_and_human_mode_needs_no_screen_to_close(monkeypatch):
    with pytest.raises(DomainError, match="render_mode"):
        gymnasium.make("nesy/PersonFollowing-v0", render_mode="ascii")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make("nesy/PersonFollowing-v0", render_mode="human")
    env.reset(seed=0)
    env.step(2)
    env.close()


def test_other_persons_are_drawn_but_never_shown_in_views():
    alone = gymnasium.make("nesy/PersonFollowing-v0", variant="clean", render_mode="rgb_array").unwrapped
    crowd = gymnasium.make("nesy/PersonFollowing-v0", variant="clean", render_mode="rgb_array", num_persons=4).unwrapped
    grid = alone.reset(seed=1) and alone.state()["grid"]
    crowd.reset(seed=1, options={"grid": grid})
    alone.reset(seed=1, options={"grid": grid})
    compared = 0
    for action in (2, 1, 2, 2, 0, 2, 3, 1, 1, 2):
        state = crowd.state()
        others = {other[:2] for other in state["others"]} - {state["agent"][:2], state["person"][:2]}
        picture = crowd.render()
        for x, y in others:
            tile = picture[y * 32 : y * 32 + 32, x * 32 : x * 32 + 32].astype(int)
            assert ((abs(tile - 100) < 60).all(axis=2)).sum() > 100
        o, _, _, _, _ = alone.step(action)
        seen, _, _, _, _ = crowd.step(action)
        if alone.state()["agent"] != crowd.state()["agent"]:
            break  # somebody stood in the way
        assert (o["view"] == seen["view"]).all()
        assert o["configuration"] == seen["configuration"]
        compared += 1
    assert compared > 1
