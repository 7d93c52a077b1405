"""The comparison: a grid of cells (agent, inputs, influence, variant, seed), each run once and kept.

Every cell is a pure function of the run folder, the settings and its seeds, and leaves one Parquet file under
results/cells/. A stopped comparison goes on with the cells that are missing, a stopped training from its last
checkpoint; where and how many at a time they run changes nothing but the timing columns.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import Domain, load_domain, location_of
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, atomic_path, write_json
from planners import config as settings
from planners.comparison.engines.dispatch import run_cells
from planners.comparison.grid import Cell, cell_path, episodes_evaluated, grid
from planners.comparison.model_store import ModelStore, NoModel
from planners.comparison.optima import count_maps, map_optimum
from planners.comparison.results import write_results
from planners.comparison.run_cell import OUT_OF_REACH, leave_out, result_of
from planners.config import CompareConfig


def compare(
    run: RunFolder,
    config: CompareConfig,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = SILENT,
    domain_name: str = "person_following",
    engine: str = "local",
    address: str | None = None,
) -> list[dict[str, Any]]:
    """Run the cells that are missing and sum all of them up.

    Args:
        run: a run with experience, world model and 2DBN.
        config: the grid.
        seed: of the run; a cell's own seed counts on top of it.
        jobs: processes.
        progress: told of finished episodes, of the whole grid.
        domain_name: which domain.
        engine: `local` for processes of this machine, `ray` for a cluster.
        address: of the Ray cluster; None for one that Ray finds or starts on this machine.

    Returns:
        The `comparison` list of summary.json.
    """
    config = replace(config, rules=tuple(str(Path(rule).resolve()) for rule in config.rules))
    cells = grid(config)
    domain = load_domain(domain_name)
    store = ModelStore(run)
    told = {variant: config.at(domain.spec.discount(variant)) for variant in config.variants}
    for variant in config.variants:
        planning = [cell for cell in cells if cell.variant == variant and cell.agent in settings.PLANNING_AGENTS]
        structured = any(cell.agent == "structured" for cell in planning)
        try:
            if planning:
                store.learn(domain, variant, config.search_of_cells, seed, structured, progress)
        except NoModel as error:
            for cell in planning:
                leave_out(run, told[variant], cell, seed, error)
    missing = [cell for cell in cells if result_of(run, told[cell.variant], cell, seed) is None]
    total = sum(_episodes(config, cell) for cell in missing)
    with progress.task("compare", total) as task:
        where = location_of(domain_name)  # a name registered here means nothing to another process
        run_cells([(cell, run.path, config, seed, where) for cell in missing], jobs, task, engine, address)
    tables = [pq.read_table(cell_path(run, cell), page_checksum_verification=True) for cell in cells]
    left_out = {
        f"{cell.agent} / {cell.variant}": table.schema.metadata[OUT_OF_REACH].decode()
        for cell, table in zip(cells, tables, strict=True)
        if OUT_OF_REACH in table.schema.metadata
    }
    played = [cell for cell in cells if f"{cell.agent} / {cell.variant}" not in left_out]
    _report_influence_rules(run, config, domain, played)
    whole = pa.concat_tables(tables, promote_options="default").replace_schema_metadata(None)
    with atomic_path(run.results / "episodes.parquet") as temporary:
        pq.write_table(whole, temporary, compression="zstd")
    optima = {variant: map_optimum(run.results, domain, variant) for variant in config.variants}
    maps = {variant: count_maps(domain, variant) for variant in config.variants}
    return write_results(run.results, whole, config, optima, left_out, maps)


def _report_influence_rules(run: RunFolder, config: CompareConfig, domain: Domain, cells: list[Cell]) -> None:
    """results/influence_rules.json: what rules about the person changed in the planners' influence, per variant."""
    path = run.results / "influence_rules.json"
    planning = {cell.variant for cell in cells if cell.agent in settings.PLANNING_AGENTS}
    if not config.rules or not planning:
        path.unlink(missing_ok=True)
        return
    from planners.person_following.influence_rules import constrain_influence

    store = ModelStore(run)
    rules = [Path(rule) for rule in config.rules]
    changes = {}
    for variant in sorted(planning):
        _, change = constrain_influence(store.local_model(variant), rules, store.codec, domain)
        changes[variant] = None if change is None else change.to_dict()
    write_json(path, changes)


def _episodes(config: CompareConfig, cell: Cell) -> int:
    learning = config.dqn.episodes if cell.agent in settings.LEARNING_AGENTS else 0
    return learning + episodes_evaluated(config, cell)
