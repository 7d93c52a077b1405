"""The comparison: a grid of cells (agent, inputs, influence, variant, seed), each run once and kept.

Every cell is a pure function of the run folder, the settings and its seeds, and leaves one Parquet file under
results/cells/. A stopped comparison goes on with the cells that are missing, a stopped training from its last
checkpoint; where and how many at a time they run changes nothing but the timing columns.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import Domain, DomainError, load_domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, atomic_path, read_json, write_json
from planners import config as settings
from planners.comparison.evaluation import Columns, evaluate, outcome_names
from planners.config import CompareConfig, SearchConfig

if TYPE_CHECKING:
    from nesy.log.experience import Experience
    from planners.person_following.ialm import IALM

TABLES_VERSION = 2
"""Of what every planner learns (planners.person_following.ialm_learning)."""
MINDS_VERSION = 2
"""Of what is learned where minds matter (planners.person_following.structured.known_maps.minds)."""
MAPPED_VERSION = 2
"""Of what is learned where walls hide things (planners.person_following.structured.drawn_maps.mapped_model)."""
OUT_OF_REACH = b"out of reach"
"""Key of a cell's metadata: why an exact oracle cannot be had on its variant."""
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
    from planners.comparison.engines import run_cells
    from planners.comparison.results import map_optimum, write_results

    config = replace(config, rules=tuple(str(Path(rule).resolve()) for rule in config.rules))
    cells = grid(config)
    domain = load_domain(domain_name)
    for variant in config.variants:
        if any(cell.agent in settings.PLANNING_AGENTS for cell in cells):
            ensure_ialm(run, domain, variant, config.search_of_cells, seed, progress)
    missing = [cell for cell in cells if _result(run, config, cell, seed) is None]
    total = sum(_episodes(config, cell) for cell in missing)
    with progress.task("compare", total) as task:
        run_cells([(cell, run.path, config, seed, domain_name) for cell in missing], jobs, task, engine, address)
    _report_influence_rules(run, config, domain, cells)
    tables = [pq.read_table(cell_path(run, cell), page_checksum_verification=True) for cell in cells]
    left_out = {
        f"{cell.agent} / {cell.variant}": table.schema.metadata[OUT_OF_REACH].decode()
        for cell, table in zip(cells, tables, strict=True)
        if OUT_OF_REACH in table.schema.metadata
    }
    whole = pa.concat_tables(tables, promote_options="default").replace_schema_metadata(None)
    with atomic_path(run.results / "episodes.parquet") as temporary:
        pq.write_table(whole, temporary, compression="zstd")
    optima = {variant: map_optimum(run.results, domain, variant) for variant in config.variants}
    return write_results(run.results, whole, config, optima, left_out)


def _report_influence_rules(run: RunFolder, config: CompareConfig, domain: Domain, cells: list[Cell]) -> None:
    """results/influence_rules.json: what rules about the person changed in the planners' influence, per variant."""
    path = run.results / "influence_rules.json"
    planning = {cell.variant for cell in cells if cell.agent in settings.PLANNING_AGENTS}
    if not config.rules or not planning:
        path.unlink(missing_ok=True)
        return
    from nesy.world_model import SymbolicCodec, load_world_model
    from planners.person_following.influence_rules import constrain_influence

    codec = SymbolicCodec(load_world_model(run.world_model))
    rules = [Path(rule) for rule in config.rules]
    changes = {}
    for variant in sorted(planning):
        _, change = constrain_influence(load_ialm(run, variant), rules, codec, domain)
        changes[variant] = None if change is None else change.to_dict()
    write_json(path, changes)


def ensure_ialm(
    run: RunFolder, domain: Domain, variant: str, config: SearchConfig, seed: int, progress: Progress = SILENT
) -> None:
    """Learn the planner's model, from the run's experience and practice of its own, unless the run holds it.

    Raises:
        UserError: the practice has fewer steps than are to be learned from.
    """
    collected = {
        "variant": variant,
        "seed": seed,
        "practice_episodes": config.practice_episodes,
        "practice_mixture": config.practice_mixture,
    }
    provenance = {
        **collected,
        "practice_steps": config.practice_steps,
        "discount": config.discount,
        "minds": MINDS_VERSION,
        "tables": TABLES_VERSION,
        "mapped": MAPPED_VERSION,
    }
    home = ialm_folder(run, variant)
    path = home / "model.json"
    before = read_json(path).get("provenance", {}) if path.is_file() else collected
    if path.is_file() and before == provenance:
        return
    from nesy.dbn import TwoSliceDBN
    from nesy.log.collection import collect_following
    from nesy.log.experience import Experience
    from nesy.world_model import SymbolicCodec, load_world_model
    from planners.person_following.ialm_learning import joined, learn_ialm
    from planners.person_following.structured.drawn_maps.mapped_learning import learn_mapped, walls_hide
    from planners.person_following.structured.known_maps.mind_learning import learn_minds, several_goals

    experience = Experience.load(run.experience)
    here = [experience] if _variant_of(run) in (None, variant) else []
    if config.practice_episodes:
        folder = home / "practice"
        if any(before.get(name) != value for name, value in collected.items()):
            shutil.rmtree(folder, ignore_errors=True)
        collect_following(
            domain, config.practice_episodes, config.practice_mixture, folder, seed, progress, variant=variant
        )
        practice = _first_steps(Experience.load(folder), config)
        here = [joined(here[0], practice) if here else practice]
        experience = joined(experience, practice)
    codec = SymbolicCodec(load_world_model(run.world_model))
    for name in ("minds.json", "minds.npz", "mapped.json", "mapped.npz"):
        (home / name).unlink(missing_ok=True)
    if here and several_goals(here[0]):
        learn_minds(codec, here[0], provenance).save(home)
    elif here and walls_hide(here[0]):
        learn_mapped(here[0], config.mind_discount, provenance).save(home)
    model = learn_ialm(TwoSliceDBN.load(run.dbn), codec, experience, provenance, config.discount)
    model.save(home)


def _first_steps(practice: Experience, config: SearchConfig) -> Experience:
    """As many steps as are to be learned from, episode after episode."""
    if not config.practice_steps:
        return practice
    if len(practice) < config.practice_steps:
        raise UserError(
            f"the practice has {len(practice):,} steps, fewer than the {config.practice_steps:,} to learn from; "
            "raise --search.practice-episodes, or lower --learning-steps"
        )
    return practice.select(np.lexsort((practice.t, practice.episode))[: config.practice_steps])


def _variant_of(run: RunFolder) -> str | None:
    """The variant that the run's own experience is of; None where the run does not say."""
    return str(read_json(run.config)["variant"]) if run.config.is_file() else None


def ialm_folder(run: RunFolder, variant: str) -> Path:
    """Where the planner's model of a variant is: ialm/, and for further variants a folder of its own in there."""
    path = run.ialm / "model.json"
    first = read_json(path).get("provenance", {}).get("variant", variant) if path.is_file() else variant
    return run.ialm if first == variant else run.ialm / variant


def load_ialm(run: RunFolder, variant: str) -> IALM:
    """The planner's model of a variant, over the run's 2DBN."""
    from nesy.dbn import TwoSliceDBN
    from planners.person_following.ialm import IALM

    return IALM.load(ialm_folder(run, variant), TwoSliceDBN.load(run.dbn))


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

    An exact oracle that is out of reach on its variant leaves no episodes, and the reason.
    """
    from planners.comparison.players import build_player

    run, domain = RunFolder(folder), load_domain(domain_name)
    fingerprint = _fingerprint(config, cell, seed)
    checkpoint = run.policies / f".{cell.name}-{fingerprint[:12]}.checkpoint.safetensors"
    episodes = _episodes_evaluated(config, cell)
    try:
        built = build_player(cell, run, domain, config, seed, progress, checkpoint)
    except DomainError as error:
        if cell.agent not in settings.ORACLES:
            raise
        nothing = {"return": np.zeros(0), "length": np.zeros(0, np.int64), "outcome": np.zeros(0, np.int64)}
        _write(run, cell, _table(cell, "eval", nothing), {"fingerprint": fingerprint, OUT_OF_REACH: str(error)})
        return advance(episodes)
    results = evaluate(domain, cell.variant, built.player, episodes, EVALUATION_SEED + cell.seed, advance)
    results["experience_steps"] = np.full(episodes, built.experience_steps)
    tables = [_table(cell, "train", built.training)] if built.training is not None else []
    table = pa.concat_tables([*tables, _table(cell, "eval", results)], promote_options="default")
    _write(run, cell, table, {"fingerprint": fingerprint})
    checkpoint.unlink(missing_ok=True)


def _write(run: RunFolder, cell: Cell, table: pa.Table, metadata: dict[Any, str]) -> None:
    with atomic_path(cell_path(run, cell)) as temporary:
        pq.write_table(table.replace_schema_metadata(metadata), temporary, compression="zstd", write_page_checksum=True)


def cell_path(run: RunFolder, cell: Cell) -> Path:
    """Where a cell leaves its episodes."""
    return run.results / "cells" / f"{cell.name}.parquet"


def _trained_with(path: str) -> tuple[str, str]:
    """Input set and influence mode of a stored policy."""
    from planners.dqn.dqn import DQNPolicy

    policy = DQNPolicy.load(Path(path))
    return policy.inputs, str(policy.trained.get("influence", "perspective-shift"))


def _episodes_evaluated(config: CompareConfig, cell: Cell) -> int:
    return config.planner_episodes if cell.agent in settings.PLANNING_AGENTS else config.episodes


def _episodes(config: CompareConfig, cell: Cell) -> int:
    learning = config.dqn.episodes if cell.agent in settings.LEARNING_AGENTS else 0
    return learning + _episodes_evaluated(config, cell)


def _fingerprint(config: CompareConfig, cell: Cell, seed: int) -> str:
    """What the cell's results depend on, besides the run's earlier steps."""
    relevant: dict[str, Any] = {
        "cell": asdict(replace(cell, policy="")),
        "seed": seed,
        "episodes": _episodes_evaluated(config, cell),
    }
    if cell.agent in settings.LEARNING_AGENTS:
        relevant["dqn"] = asdict(replace(config.dqn_of_cells, checkpoint_seconds=0.0))
    if cell.agent in settings.PLANNING_AGENTS:
        relevant["search"] = asdict(config.search_of_cells)
        relevant["learned"] = TABLES_VERSION, MINDS_VERSION, MAPPED_VERSION
    try:
        files = [*config.rules, *([cell.policy] if cell.policy else [])]
        relevant["files"] = [hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files]
    except OSError as error:
        raise UserError(f"{error.filename}: not readable ({error.strerror})") from None
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def _result(run: RunFolder, config: CompareConfig, cell: Cell, seed: int) -> pa.Table | None:
    """The episodes that a cell has left; None where it is to be run (again): none yet, of other settings, damaged."""
    try:
        table = pq.read_table(cell_path(run, cell), page_checksum_verification=True)
    except (OSError, pa.ArrowException):
        return None
    metadata = table.schema.metadata or {}
    return table if metadata.get(b"fingerprint") == _fingerprint(config, cell, seed).encode() else None


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
    for name in ("map_id", "step", "experience_steps"):
        values[name] = pa.array(columns[name], pa.int64()) if name in columns else pa.nulls(count, pa.int64())
    for name in columns:  # the metrics of the domain
        if name not in values and name != "steps":
            values[name] = pa.array(np.asarray(columns[name], np.float64), pa.float64(), from_pandas=True)
    return pa.table(values)
