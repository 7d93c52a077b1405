"""Which algorithm decides, and with what model: by name alone, and every row says it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from domains.core import load_domain
from nesy.run_folder import RunFolder, read_json
from planners.comparison.compare import compare
from planners.comparison.grid import Cell
from planners.comparison.players import restored_player
from planners.config import CompareConfig, SearchConfig
from planners.person_following.agent import PlanningAgent
from planners.person_following.structured.drawn_maps.mapped_agent import MappedAgent
from planners.person_following.structured.known_maps.mind_agent import MindAgent

SMALL = SearchConfig(simulations=16, particles=20, practice_episodes=150)
STRUCTURED = {"intent": MindAgent, "occluded": MappedAgent}


@pytest.fixture(scope="module")
def compared(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, CompareConfig]:
    """`search` and `structured` on every variant, with models learned from little."""
    run = RunFolder(tmp_path_factory.mktemp("compared"))
    for name in ("world_model", "dbn", "experience", "config.json"):
        (run.path / name).symlink_to((tiny_run / name).resolve())
    config = CompareConfig(
        agents=("search", "structured", "greedy-last-seen"),
        influences=("perspective-shift",),
        variants=("paper", *STRUCTURED),
        episodes=1,
        planner_episodes=1,
    )
    config = replace(config, search=SMALL)
    compare(run, config)
    return run, config


def test_search_plans_with_the_learned_local_model_on_every_variant(
    compared: tuple[RunFolder, CompareConfig],
) -> None:
    run, config = compared
    for variant in config.variants:
        for agent in ("search", "structured") if variant in STRUCTURED else ("search",):
            cell = Cell(agent, "full", "perspective-shift", variant, 0)
            player = restored_player(cell, run, load_domain(), config, 0)
            assert type(player.agent) is (PlanningAgent if agent == "search" else STRUCTURED[variant])


def test_every_row_says_what_decided_and_with_what_model(compared: tuple[RunFolder, CompareConfig]) -> None:
    run, config = compared
    rows = pq.read_table(run.results / "episodes.parquet").to_pylist()
    said = {(row["agent"], row["variant"]): (row["algorithm"], row["model"]) for row in rows}
    assert all(algorithm and model for algorithm, model in said.values())
    for variant in config.variants:
        assert said["search", variant][0] == "PO-UCT"
        assert "2DBN" in said["search", variant][1]
    for variant in STRUCTURED:
        assert "hand-structured" in said["structured", variant][1]
        assert "2DBN" not in said["structured", variant][1]


def test_structured_is_left_out_where_none_was_written(compared: tuple[RunFolder, CompareConfig]) -> None:
    left_out = read_json(compared[0].results / "statistics.json")["left_out"]
    assert list(left_out) == ["structured / paper"]
    assert "no hand-structured model" in left_out["structured / paper"]
