"""The comparison: a grid of cells (agent, inputs, influence, variant, seed), each run once and kept.

Every cell is a pure function of the run folder, the settings and its seeds, and leaves one Parquet file under
results/cells/. A stopped comparison goes on with the cells that are missing; the number of processes changes
nothing but the timing columns.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import Domain, DomainError, load_domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, atomic_path, read_json, write_json
from planners import config as settings
from planners.config import CompareConfig, SearchConfig
from planners.evaluation import Columns, evaluate, outcome_names
from planners.statistics import Interval, bootstrap

EVALUATION_SEED = 20_250_420
"""Seed of all evaluation episodes, whatever the seed of the run: results of different runs compare."""


@dataclass(frozen=True)
class Cell:
    """One agent under one condition with one seed; `inputs` and `influence` are empty where they mean nothing."""

    agent: str
    inputs: str
    influence: str
    variant: str
    seed: int

    @property
    def name(self) -> str:
        """File name of the cell's results."""
        return "-".join(part for part in (self.agent, self.inputs, self.influence, self.variant) if part) + (
            f"-seed{self.seed}"
        )


def grid(config: CompareConfig) -> list[Cell]:
    """All cells, in the order of the table.

    Raises:
        UserError: an unknown agent, input set or influence mode, or none at all.
    """
    for name, chosen, known in (
        ("agent", config.agents, settings.AGENTS),
        ("input set", config.inputs, settings.INPUT_SETS),
        ("influence mode", config.influences, settings.INFLUENCE_MODES),
    ):
        for item in chosen:
            if item not in known:
                raise UserError(f"unknown {name} '{item}' (known: {', '.join(known)})")
    for name, values in (("agents", config.agents), ("variants", config.variants), ("seeds", config.seeds)):
        if not values:
            raise UserError(f"nothing to compare: the list of {name} is empty")
    if min(config.episodes, config.planner_episodes) < 1:
        raise UserError("at least one evaluation episode is needed")
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
    return cells


def compare(
    run: RunFolder,
    config: CompareConfig,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = SILENT,
    domain_name: str = "person_following",
) -> list[dict[str, Any]]:
    """Run the cells that are missing and sum all of them up.

    Args:
        run: a run with experience, world model and 2DBN.
        config: the grid.
        seed: of the run; a cell's own seed counts on top of it.
        jobs: processes.
        progress: told of finished episodes, of the whole grid.
        domain_name: which domain.

    Returns:
        The `comparison` list of summary.json.
    """
    from planners.engines import run_cells

    cells = grid(config)
    domain = load_domain(domain_name)
    if any(cell.agent in settings.PLANNING_AGENTS for cell in cells):
        ensure_ialm(run, domain, config.variants[0], config.search, seed, progress)
    missing = [cell for cell in cells if not _is_done(run, config, cell, seed)]
    total = sum(_episodes(config, cell) for cell in missing)
    with progress.task("compare", total) as task:
        jobs_of = [(cell, run.path, config, seed, domain_name) for cell in missing]
        run_cells(jobs_of, jobs, task)
    tables = [pq.read_table(_path(run, cell)) for cell in cells]
    with atomic_path(run.results / "episodes.parquet") as temporary:
        pq.write_table(pa.concat_tables(tables).replace_schema_metadata(None), temporary, compression="zstd")
    optima = {variant: _optimum(run, domain, variant) for variant in config.variants}
    return summarise(cells, tables, config, optima)


def ensure_ialm(
    run: RunFolder, domain: Domain, variant: str, config: SearchConfig, seed: int, progress: Progress = SILENT
) -> None:
    """Learn the planner's model, from the run's experience and practice of its own, unless the run holds it."""
    provenance = {
        "variant": variant,
        "seed": seed,
        "practice_episodes": config.practice_episodes,
        "practice_mixture": config.practice_mixture,
        "discount": config.discount,
    }
    path = run.ialm / "model.json"
    if path.is_file() and read_json(path).get("provenance") == provenance:
        return
    from nesy.collection import collect_following
    from nesy.dbn import TwoSliceDBN
    from nesy.experience import Experience
    from nesy.world_model import SymbolicCodec, load_world_model
    from planners.ialm_learning import joined, learn_ialm

    experience = Experience.load(run.experience)
    if config.practice_episodes:
        folder = run.ialm / "practice"
        if path.is_file():
            shutil.rmtree(folder, ignore_errors=True)  # of other settings
        collect_following(
            domain, config.practice_episodes, config.practice_mixture, folder, seed, progress, variant=variant
        )
        experience = joined(experience, Experience.load(folder))
    codec = SymbolicCodec(load_world_model(run.world_model))
    model = learn_ialm(TwoSliceDBN.load(run.dbn), codec, experience, provenance, config.discount)
    model.save(run.ialm)


def run_cell(
    cell: Cell,
    folder: Path,
    config: CompareConfig,
    seed: int,
    domain_name: str,
    progress: Progress = SILENT,
    advance: Callable[[int], None] = lambda count: None,
) -> None:
    """Run one cell and write its episodes (and the trained policy, if it learns)."""
    from planners.cells import build_agent

    run, domain = RunFolder(folder), load_domain(domain_name)
    agent, perception, training = build_agent(cell, run, domain, config, seed, progress, advance)
    episodes = _episodes_evaluated(config, cell)
    results = evaluate(domain, cell.variant, agent, perception, episodes, EVALUATION_SEED + cell.seed, advance)
    tables = [_table(cell, "train", training)] if training is not None else []
    table = pa.concat_tables([*tables, _table(cell, "eval", results)])
    table = table.replace_schema_metadata({"fingerprint": _fingerprint(config, cell, seed)})
    with atomic_path(_path(run, cell)) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def summarise(
    cells: list[Cell], tables: list[pa.Table], config: CompareConfig, optima: dict[str, dict[str, float] | None]
) -> list[dict[str, Any]]:
    """One record per (agent, inputs, influence, variant), seeds pooled."""
    groups: dict[tuple[str, str, str, str], list[int]] = {}
    for i, cell in enumerate(cells):
        groups.setdefault((cell.agent, cell.inputs, cell.influence, cell.variant), []).append(i)
    records = []
    for (agent, inputs, influence, variant), members in groups.items():
        rows = [tables[i].filter(pa.compute.equal(tables[i]["phase"], "eval")) for i in members]
        returns = np.concatenate([row["return"].to_numpy() for row in rows])
        success = np.concatenate([row["outcome"].to_numpy(zero_copy_only=False) for row in rows]) == "success"
        milliseconds = np.concatenate([row["ms"].to_numpy() for row in rows])
        optimum = optima.get(variant)
        mean_return = bootstrap(returns, seed=0, confidence=config.confidence).as_dict()
        mean_success = bootstrap(success, seed=0, confidence=config.confidence).as_dict()
        if agent == "optimum" and optimum is not None:
            mean_return, mean_success = _exact(optimum["mean_return"]), _exact(optimum["success"])
        records.append(
            {
                "agent": agent,
                "inputs": inputs,
                "influence": influence,
                "variant": variant,
                "seeds": [cells[i].seed for i in members],
                "episodes": len(returns),
                "return": mean_return,
                "success": mean_success,
                "ms_per_decision": float(np.median(milliseconds)),
                "share_of_optimum": None if optimum is None else mean_return["mean"] / optimum["mean_return"],
            }
        )
    return records


def _exact(value: float) -> dict[str, Any]:
    return {**Interval(value, value, value).as_dict(), "low": None, "high": None}


def _optimum(run: RunFolder, domain: Domain, variant: str) -> dict[str, float] | None:
    """Mean return and success of the exact optimum; worked out once and kept. None where it is out of reach."""
    path = run.results / f"optimum-{variant}.json"
    if not path.is_file():
        try:
            oracle = domain.optimum(variant)
        except DomainError:
            return None
        write_json(path, {"mean_return": oracle.mean_return, "success": oracle.success})
    value = read_json(path)
    return {name: float(value[name]) for name in ("mean_return", "success")}


def _episodes_evaluated(config: CompareConfig, cell: Cell) -> int:
    return config.planner_episodes if cell.agent in settings.PLANNING_AGENTS else config.episodes


def _episodes(config: CompareConfig, cell: Cell) -> int:
    learning = config.dqn.episodes if cell.agent in settings.LEARNING_AGENTS else 0
    return learning + _episodes_evaluated(config, cell)


def _path(run: RunFolder, cell: Cell) -> Path:
    return run.results / "cells" / f"{cell.name}.parquet"


def _fingerprint(config: CompareConfig, cell: Cell, seed: int) -> str:
    """What the cell's results depend on, besides the run's earlier steps."""
    relevant: dict[str, Any] = {"cell": asdict(cell), "seed": seed, "episodes": _episodes_evaluated(config, cell)}
    if cell.agent in settings.LEARNING_AGENTS:
        relevant["dqn"] = asdict(config.dqn)
    if cell.agent in settings.PLANNING_AGENTS:
        relevant["search"] = asdict(config.search)
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def _is_done(run: RunFolder, config: CompareConfig, cell: Cell, seed: int) -> bool:
    try:
        metadata = pq.read_schema(_path(run, cell)).metadata or {}
    except (OSError, pa.ArrowException):
        return False  # missing, or cut off: run it again
    return metadata.get(b"fingerprint", b"").decode() == _fingerprint(config, cell, seed)


def _table(cell: Cell, phase: str, columns: Columns) -> pa.Table:
    """The rows of results/episodes.parquet; measures that a phase lacks are null."""
    count = len(columns["return"])
    values: dict[str, pa.Array] = {
        name: pa.array([value] * count, pa.string())
        for name, value in (
            ("agent", cell.agent),
            ("inputs", cell.inputs),
            ("influence", cell.influence),
            ("variant", cell.variant),
        )
    }
    values["seed"] = pa.array(np.full(count, cell.seed), pa.int64())
    values["phase"] = pa.array([phase] * count, pa.string())
    values["episode"] = pa.array(np.arange(count), pa.int64())
    values["return"] = pa.array(columns["return"], pa.float64())
    values["length"] = pa.array(columns["length"], pa.int64())
    values["outcome"] = pa.array(outcome_names(columns["outcome"]), pa.string())
    for name, kind in (
        ("map_id", pa.int64()),
        ("discounted_return", pa.float64()),
        ("visible", pa.float64()),
        ("distance", pa.float64()),
        ("waits", pa.float64()),
        ("step", pa.int64()),
        ("ms", pa.float64()),
    ):
        values[name] = pa.array(columns[name], kind) if name in columns else pa.nulls(count, kind)
    return pa.table(values)
