"""One cell of a comparison: its player built, its episodes played, one Parquet file written.

A cell is a pure function of the run folder, the settings and its seeds; a stopped training goes on from its last
checkpoint.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import DomainError, load_domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, atomic_path
from planners import config as settings
from planners.agents import Agent
from planners.comparison.evaluation import Columns, evaluate, outcome_names
from planners.comparison.grid import EVALUATION_SEED, Cell, cell_path, episodes_evaluated
from planners.comparison.model_store import STRUCTURED_VERSION, TABLES_VERSION, NoModel
from planners.comparison.players import build_player
from planners.config import CompareConfig

OUT_OF_REACH = b"out of reach"
"""Key of a cell's metadata: why an exact oracle, or what the agent plans with, cannot be had on its variant."""


def run_cell(
    cell: Cell,
    folder: Path,
    config: CompareConfig,
    seed: int,
    domain_name: str,
    progress: Progress = SILENT,
    advance: Callable[[int], None] = lambda count: None,
) -> None:
    """Run one cell and write its episodes (and the trained policy, if it learns).

    A reference that cannot be had on its variant, such as an exact oracle, leaves no episodes, and the reason; so does
    an agent whose model does not exist there.
    """
    run, domain = RunFolder(folder), load_domain(domain_name)
    config = config.at(domain.spec.discount(cell.variant))
    fingerprint = _fingerprint(config, cell, seed)
    checkpoint = run.policies / f".{cell.name}-{fingerprint[:12]}.checkpoint.safetensors"
    episodes = episodes_evaluated(config, cell)
    try:
        built = build_player(cell, run, domain, config, seed, progress, checkpoint)
    except (DomainError, NoModel) as error:
        if isinstance(error, DomainError) and cell.agent not in settings.REFERENCE_AGENTS:
            raise
        leave_out(run, config, cell, seed, error)
        return advance(episodes)
    results = evaluate(domain, cell.variant, built.player, episodes, EVALUATION_SEED + cell.seed, advance)
    results["experience_steps"] = np.full(episodes, built.experience_steps)
    tables = [_table(cell, "train", built.training, built.player.agent)] if built.training is not None else []
    evaluated = _table(cell, "eval", results, built.player.agent)
    table = pa.concat_tables([*tables, evaluated], promote_options="default")
    _write(run, cell, table, {"fingerprint": fingerprint})
    checkpoint.unlink(missing_ok=True)


def leave_out(run: RunFolder, config: CompareConfig, cell: Cell, seed: int, reason: Exception) -> None:
    """Write down that a cell's agent cannot be had, and why, in place of its episodes."""
    nothing = {"return": np.zeros(0), "length": np.zeros(0, np.int64), "outcome": np.zeros(0, np.int64)}
    metadata = {"fingerprint": _fingerprint(config, cell, seed), OUT_OF_REACH: str(reason)}
    _write(run, cell, _table(cell, "eval", nothing, None), metadata)


def _write(run: RunFolder, cell: Cell, table: pa.Table, metadata: dict[Any, str]) -> None:
    with atomic_path(cell_path(run, cell)) as temporary:
        pq.write_table(table.replace_schema_metadata(metadata), temporary, compression="zstd", write_page_checksum=True)


def result_of(run: RunFolder, config: CompareConfig, cell: Cell, seed: int) -> pa.Table | None:
    """The episodes that a cell has left; None where it is to be run (again): none yet, of other settings, damaged."""
    try:
        table = pq.read_table(cell_path(run, cell), page_checksum_verification=True)
    except (OSError, pa.ArrowException):
        return None
    metadata = table.schema.metadata or {}
    return table if metadata.get(b"fingerprint") == _fingerprint(config, cell, seed).encode() else None


def _fingerprint(config: CompareConfig, cell: Cell, seed: int) -> str:
    """What the cell's results depend on, besides the run's earlier steps."""
    relevant: dict[str, Any] = {
        "cell": asdict(replace(cell, policy="")),
        "seed": seed,
        "episodes": episodes_evaluated(config, cell),
    }
    if cell.agent in settings.LEARNING_AGENTS:
        relevant["dqn"] = asdict(replace(config.dqn_of_cells, checkpoint_seconds=0.0))
    if cell.agent in settings.PLANNING_AGENTS:
        relevant["search"] = asdict(config.search_of_cells)
        relevant["learned"] = STRUCTURED_VERSION if cell.agent == "structured" else TABLES_VERSION
    try:
        files = [*config.rules, *([cell.policy] if cell.policy else [])]
        relevant["files"] = [hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files]
    except OSError as error:
        raise UserError(f"{error.filename}: not readable ({error.strerror})") from None
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def _table(cell: Cell, phase: str, columns: Columns, agent: Agent | None) -> pa.Table:
    """The rows of results/episodes.parquet; measures that a phase lacks are null."""
    count = len(columns["return"])
    values: dict[str, pa.Array] = {
        name: pa.array([value] * count, pa.string())
        for name, value in (
            ("agent", cell.agent),
            ("inputs", cell.inputs),
            ("influence", cell.influence),
            ("variant", cell.variant),
            ("algorithm", "" if agent is None else agent.algorithm),
            ("model", "" if agent is None else agent.model),
        )
    }
    values["seed"] = pa.array(np.full(count, cell.seed), pa.int64())
    values["phase"] = pa.array([phase] * count, pa.string())
    values["episode"] = pa.array(np.arange(count), pa.int64())
    values["return"] = pa.array(columns["return"], pa.float64())
    values["length"] = pa.array(columns["length"], pa.int64())
    values["outcome"] = pa.array(outcome_names(columns["outcome"]), pa.string())
    for name in ("map_id", "step", "experience_steps"):
        values[name] = pa.array(columns[name], pa.int64()) if name in columns else pa.nulls(count, pa.int64())
    for name in columns:  # the metrics of the domain
        if name not in values and name != "steps":
            values[name] = pa.array(np.asarray(columns[name], np.float64), pa.float64(), from_pandas=True)
    return pa.table(values)
