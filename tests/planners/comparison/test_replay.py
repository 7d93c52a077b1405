"""Replays: which episodes are chosen, and that they run as they did in the comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from nesy.errors import UserError
from planners.comparison.grid import Cell
from planners.comparison.replay.choice import choose
from planners.comparison.replay.record import load_replays


def cell(agent: str) -> Cell:
    return Cell(agent, "", "", "paper", 0)


def results(returns: list[float], outcomes: list[str], maps: list[int]) -> dict[str, list[Any]]:
    return {"return": returns, "outcome": outcomes, "map_id": maps}


TABLES = {
    cell("optimum"): results([100.0, 5.0, 100.0], ["success", "lost", "success"], [1, 2, 3]),
    cell("random"): results([1.0, 4.0, 90.0], ["lost", "lost", "success"], [1, 2, 9]),
}


def test_first_success_first_failure_and_worst_regret_are_chosen() -> None:
    chosen = choose(TABLES)
    picked = {(item.episode, item.reasons): item.regret for item in chosen[cell("random")]}
    assert picked == {(0, ("first failure", "worst regret")): 99.0, (2, ("first success",)): None}  # another map
    # the optimum has nothing to regret, and without it nobody has: no other agent stands in for it
    assert [item.reasons for item in chosen[cell("optimum")]] == [("first success",), ("first failure",)]
    alone = choose({cell("random"): TABLES[cell("random")], cell("dqn"): TABLES[cell("optimum")]})
    assert all(item.regret is None for items in alone.values() for item in items)


def test_no_more_than_asked_for() -> None:
    assert sum(len(items) for items in choose(TABLES, most=2).values()) == 2


def test_replays_run_as_in_the_comparison(tiny_run: Path) -> None:
    replays = load_replays(tiny_run / "results" / "replays.json")
    assert {e["agent"] for e in replays["episodes"]} >= {"dqn", "pomdp", "random", "optimum"}
    for episode in replays["episodes"]:
        assert episode["reproduced"], (episode["agent"], episode["influence"], episode["episode"])
        assert sum(step["reward"] for step in episode["steps"]) == pytest.approx(episode["return"], abs=0.01)
        assert ("q" in episode["steps"][0]) == (episode["agent"] == "dqn")
        assert ("plan" in episode["steps"][0]) == (episode["agent"] in ("pomdp", "search"))


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "replays.json"
    path.write_text('{"format": "nesy-replays", "version": 99}')
    with pytest.raises(UserError, match=r"replays\.json"):
        load_replays(path)
