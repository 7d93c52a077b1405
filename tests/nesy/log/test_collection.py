from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from domains.core import load_domain
from nesy.config import CollectConfig
from nesy.errors import UserError
from nesy.log.collection import collect, plan
from nesy.log.experience import COLUMNS, Experience

CONFIG = CollectConfig(crossing_episodes=8, following_episodes=16, num_envs=3, shard_episodes=5)


def test_plan_splits_sources_and_shards() -> None:
    shards = plan(CONFIG)
    episodes: dict[str, int] = {}
    for shard in shards:
        assert shard.episodes <= 5
        episodes[shard.source] = episodes.get(shard.source, 0) + shard.episodes
    assert episodes == {
        "crossing-random": 4,
        "crossing-expert": 4,
        "crossing-explore": 8,
        "following-random": 4,
        "following-expert": 4,
        "following-mixture": 8,
    }
    assert [shard.first_episode for shard in shards] == [0, 4, 8, 13, 16, 20, 24, 29]
    with pytest.raises(UserError, match="no episodes"):
        plan(CollectConfig(crossing_episodes=0, following_episodes=0))
    with pytest.raises(UserError, match="num_envs"):
        plan(CollectConfig(num_envs=0))


def test_collect_is_deterministic_and_resumes_by_shard(tmp_path: Path) -> None:
    domain = load_domain()
    rows = collect(domain, CONFIG, tmp_path / "a", seed=7)
    whole = Experience.load(tmp_path / "a")
    assert rows == len(whole)
    collect(domain, CONFIG, tmp_path / "b", seed=7)
    parts = sorted((tmp_path / "b").glob("part-*.parquet"))
    untouched = parts[0].stat().st_mtime_ns
    parts[1].unlink()
    parts[3].write_bytes(b"half written")
    assert collect(domain, CONFIG, tmp_path / "b", seed=7) == rows
    assert parts[0].stat().st_mtime_ns == untouched
    again = Experience.load(tmp_path / "b")
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(whole, name), getattr(again, name))
    other = collect(domain, CONFIG, tmp_path / "c", seed=8)
    assert other != rows or not np.array_equal(Experience.load(tmp_path / "c").action, whole.action)


def test_rows_are_whole_episodes_in_order(tmp_path: Path) -> None:
    collect(load_domain(), CONFIG, tmp_path, seed=3)
    e = Experience.load(tmp_path)
    ended = e.terminated | e.truncated
    assert sorted(set(e.episode)) == list(range(32))
    starts = np.flatnonzero(e.t == 0)
    assert len(starts) == 32
    assert ended[np.append(starts[1:] - 1, len(e) - 1)].all()
    assert ended.sum() == 32
    inside = np.flatnonzero(~ended)
    np.testing.assert_array_equal(e.next_view[inside], e.view[inside + 1])
    np.testing.assert_array_equal(e.next_configuration[inside], e.configuration[inside + 1])
    np.testing.assert_array_equal(e.next_relative_pose[inside], e.relative_pose[inside + 1])
    np.testing.assert_array_equal(e.next_person_view[inside], e.person_view[inside + 1])
    np.testing.assert_array_equal(e.map_id[inside], e.map_id[inside + 1])
    assert (e.t[inside] + 1 == e.t[inside + 1]).all()
    crossing = np.char.startswith(e.source, "crossing")
    assert (e.configuration[crossing] == 0).all()
    expert = e.source == "crossing-expert"
    assert e.terminated[expert & ended].all()
    explored = e.source == "crossing-explore"
    assert e.view[explored].max() == 2
    assert (e.reward[expert & ended] > 0.8).all()


@pytest.mark.parametrize("actions", [("left", "right"), ("left", "right", "forward")])
def test_only_actions_that_exist_are_drawn(actions: tuple[str, ...], tmp_path: Path) -> None:
    class FewActions:
        spec = replace(load_domain().spec, action_names=actions)

        def make(self, *arguments: Any, **keywords: Any) -> Any:
            env = load_domain().make(*arguments, **keywords)
            step = env.step
            env.expert_actions = lambda kind: np.zeros(env.num_envs, np.int64)

            def checked(action: np.ndarray) -> Any:
                assert action.max() < len(actions), "the world has no such action"
                return step(action)

            env.step = checked
            return env

    collect(FewActions(), CollectConfig(crossing_episodes=4, following_episodes=8, num_envs=4), tmp_path, seed=0)  # type: ignore[arg-type]
    assert sorted(set(Experience.load(tmp_path).action.tolist())) == list(range(len(actions)))
