"""The grid of a comparison: its cells (agent, inputs, influence, variant, seed), in the order of the table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nesy.run_folder import RunFolder
from planners import config as settings
from planners.config import CompareConfig

EVALUATION_SEED = 20_250_420
"""Seed of all evaluation episodes, whatever the seed of the run: results of different runs compare."""


@dataclass(frozen=True)
class Cell:
    """One agent under one condition with one seed; `inputs` and `influence` are empty where they mean nothing.

    `policy` is the file of an agent that was trained elsewhere.
    """

    agent: str
    inputs: str
    influence: str
    variant: str
    seed: int
    policy: str = ""

    @property
    def name(self) -> str:
        """File name of the cell's results."""
        parts = (part for part in (self.agent, self.inputs, self.influence, self.variant) if part)
        return "-".join(parts) + f"-seed{self.seed}"


def grid(config: CompareConfig) -> list[Cell]:
    """All cells, in the order of the table.

    Raises:
        UserError: a policy that cannot be read.
    """
    cells = []
    for variant in config.variants:
        for agent in config.agents:
            inputs = config.inputs if agent in settings.LEARNING_AGENTS else ("full",)
            influences: tuple[str, ...] = config.influences
            if agent in settings.REFERENCE_AGENTS:
                inputs, influences = ("",), ("",)
            cells += [
                Cell(agent, i, influence, variant, seed)
                for i in inputs
                for influence in influences
                for seed in config.seeds
            ]
        cells += [
            Cell(f"file {Path(path).stem}", *_trained_with(path), variant, seed, str(Path(path).resolve()))
            for path in config.policies
            for seed in config.seeds
        ]
    return cells


def episodes_evaluated(config: CompareConfig, cell: Cell) -> int:
    """How many episodes the cell is evaluated in."""
    return config.planner_episodes if cell.agent in settings.PLANNING_AGENTS else config.episodes


def cell_path(run: RunFolder, cell: Cell) -> Path:
    """Where a cell leaves its episodes."""
    return run.results / "cells" / f"{cell.name}.parquet"


def _trained_with(path: str) -> tuple[str, str]:
    """Input set and influence mode of a stored policy."""
    from planners.dqn.dqn import DQNPolicy

    policy = DQNPolicy.load(Path(path))
    return policy.inputs, str(policy.trained.get("influence", "perspective-shift"))
