"""The pipeline: collect, train, extract, compare, report, each step resumable and done once.

A finished step is not repeated. Asked to repeat it with other settings, the pipeline refuses unless told to
redo it; redoing a step removes what was built on it.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from nesy.cli import configuration
from nesy.cli.configuration import PRESETS, PresetName, RunConfig
from nesy.errors import UserError
from nesy.progress import ConsoleProgress, Progress
from nesy.run_folder import RunFolder, read_json, write_json

# What each step leaves in the run folder, in pipeline order: redoing a step removes its own and all later ones.
OUTPUTS: dict[str, tuple[str, ...]] = {
    "collect": ("experience",),
    "train": ("world_model",),
    "extract": ("dbn",),
    "compare": ("ialm", "policies", "results"),
    "report": ("report.html",),
}
# What each step writes into summary.json, as sections or as times; what an interruption left out is made good.
SECTIONS: dict[str, tuple[str, ...]] = {
    "collect": ("experience",),
    "train": ("world_model",),
    "extract": ("dbn", "fidelity", "perspective", "semantics"),
    "compare": ("comparison", "replays"),
    "report": (),
}
LIBRARIES = ("torch", "numpy", "numba", "gymnasium", "minigrid", "pomdp-py", "clingo", "pyarrow", "scipy")


@dataclass(frozen=True)
class CommonArguments:
    """Options that every step of the pipeline takes."""

    run: Path = Path("runs/default")
    """The run folder."""
    preset: PresetName | None = None
    """Settings to start from: smoke, quick or paper (default: those of the run, or quick for a new one). World, variant
    and seed stay those of the run."""
    world: str | None = None
    """The world: person_following, or a domain of your own as package.module:ATTRIBUTE, whose module is also looked
    for in the current folder (default: that of the run, or person_following)."""
    variant: str | None = None
    """Variant of the world (default: that of the run, or the world's first: paper)."""
    seed: int | None = None
    """Seed of everything random (default: that of the run, or 0)."""
    jobs: int = 2
    """Processes for work that can be done side by side; the results do not depend on it."""
    redo: bool = False
    """Do the step again and remove what was built on it."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def base_config(arguments: list[str]) -> RunConfig:
    """The configuration that the options on the command line then change.

    That is the run's own, or the preset's when one is named or the run is new. World, variant and seed are the run's
    own even then; with another variant, that is what is compared. It has to be known before the other options are
    parsed, so that their help shows the values that would really be used.
    """
    path = Path(option(arguments, "--run") or CommonArguments.run) / "config.json"
    own = configuration.load(path) if path.is_file() else None
    preset = PRESETS.get(option(arguments, "--preset") or ("quick" if own is None else ""))
    config = preset or own or PRESETS["quick"]
    if own is not None and preset is not None:
        config = _with_variant(replace(config, domain=own.domain, seed=own.seed), own.variant)
    world, variant = option(arguments, "--world") or config.domain, option(arguments, "--variant")
    if variant is None and world != config.domain:
        from domains.core import load_domain

        variant = load_domain(world).spec.variants[0]
    config = replace(config, domain=world)
    return config if variant is None else _with_variant(config, variant)


def _with_variant(config: RunConfig, variant: str) -> RunConfig:
    """The configuration for a variant, which is also what is compared; unchanged where it is for that already."""
    if variant == config.variant:
        return config
    return replace(config, variant=variant, compare=replace(config.compare, variants=(variant,)))


def config_of(options: CommonArguments) -> RunConfig:
    """The configuration that parsed options refer to: see `base_config`."""
    arguments = ["--run", str(options.run)]
    for name, value in (("--preset", options.preset), ("--world", options.world), ("--variant", options.variant)):
        if value is not None:
            arguments += [name, value]
    return base_config(arguments)


def option(arguments: list[str], name: str) -> str | None:
    """What the command line gives for an option; None where it does not."""
    for position, argument in enumerate(arguments):
        if argument == name and position + 1 < len(arguments):
            return arguments[position + 1]
        if argument.startswith(name + "="):
            return argument[len(name) + 1 :]
    return None


@contextmanager
def opened(options: CommonArguments, step: str, **sections: Any) -> Iterator[Pipeline]:
    """The pipeline of the run that the options name, locked for writing and configured.

    Args:
        options: the parsed options of the command.
        step: the first step that the command does; only the first of all may make a new run folder.
        sections: the configuration's sections that the command's options set.

    Raises:
        UserError: the folder is missing, locked, or holds steps made with other settings; a setting cannot be met.
            Then nothing has been written.
    """
    if options.run.exists() and not options.run.is_dir():
        raise UserError(f"{options.run}: is a file; a run is a folder")
    if step != next(iter(OUTPUTS)):
        RunFolder.open(options.run)
    base = config_of(options)
    config = replace(base, seed=base.seed if options.seed is None else options.seed, **sections)
    pipeline = Pipeline(options.run, config, options.jobs)
    _check_names(config)
    pipeline = Pipeline(options.run, _in_world(config), options.jobs)
    with pipeline.run.lock():
        pipeline.configure(redo_from=step if options.redo else None)
        yield pipeline


def _check_names(config: RunConfig) -> None:
    """Whether the variants are the domain's, and the files that a comparison reads are there."""
    from domains.core import load_domain

    known = load_domain(config.domain).spec.variants
    for variant in (config.variant, *config.compare.variants):
        if variant not in known:
            raise UserError(f"unknown variant '{variant}' (known: {', '.join(known)})")
    for path in (*config.compare.rules, *config.compare.policies):
        if not Path(path).is_file():
            raise UserError(f"{path}: no such file")


def _in_world(config: RunConfig) -> RunConfig:
    """The configuration with what it leaves to its world; see `TrainConfig.in_world`."""
    from domains.core import load_domain, symmetries_of

    domain = load_domain(config.domain)
    train = config.train.in_world(domain.spec.name, domain.spec.weighting, bool(symmetries_of(domain)))
    return replace(config, train=train)


class Pipeline:
    """One run folder, its configuration, and the steps."""

    def __init__(self, folder: Path, config: RunConfig, jobs: int, progress: Progress | None = None) -> None:
        if jobs < 1:
            raise UserError(f"--jobs {jobs}: at least one process is needed")
        self.run = RunFolder(folder)
        self.config = config
        self.jobs = jobs
        self.progress = progress or ConsoleProgress()

    def configure(self, redo_from: str | None = None) -> None:
        """Write config.json, after checking that no finished step was made with other settings.

        Raises:
            UserError: a finished step was made with other settings and is not to be redone.
        """
        if redo_from is not None:
            self._remove_from(redo_from)
        if self.run.has("config"):
            self._check_unchanged(_in_world(configuration.load(self.run.config)))
        elif self.run.path.is_dir() and any(not item.name.startswith(".") for item in self.run.path.iterdir()):
            raise UserError(f"{self.run.path}: holds files but no config.json, so it is no run folder; name another")
        if not self.run.has("config"):
            configuration.save(self.config, self.run.config, _versions())
        elif configuration.load(self.run.config) != self.config:  # nothing has been done yet: versions stay
            configuration.save(self.config, self.run.config, configuration.versions(self.run.config))

    def _check_unchanged(self, old: RunConfig) -> None:
        shared = {"domain": "world", "variant": "variant", "seed": "seed"}
        for step in ("collect", "train", "extract"):
            if not self.run.has(step):
                continue
            changed = [
                f"{word}: {getattr(old, name)}, now {getattr(self.config, name)}"
                for name, word in shared.items()
                if getattr(old, name) != getattr(self.config, name)
            ]
            changed += configuration.differences(getattr(old, step), getattr(self.config, step), f"{step}.")
            if changed:
                raise UserError(
                    f"{self.run.path}: '{step}' was made with other settings ({'; '.join(changed)}); "
                    f"name another --run, or redo it with: nesy {step} --run {self.run.path} --redo"
                )

    def _remove_from(self, first: str) -> None:
        steps = list(OUTPUTS)
        for step in steps[steps.index(first) :]:
            for name in OUTPUTS[step]:
                path = self.run.path / name
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
        gone = {name for step in steps[steps.index(first) :] for name in (step, *SECTIONS[step])}
        if self.run.summary.is_file():
            kept = {name: value for name, value in self.run.read_summary().items() if name not in gone}
            kept["timing"] = {name: value for name, value in kept.get("timing", {}).items() if name not in gone}
            if "provenance" in kept:
                steps_of = kept["provenance"].get("steps", {})
                kept["provenance"]["steps"] = {name: value for name, value in steps_of.items() if name not in gone}
            write_json(self.run.summary, kept)

    def _timed(self, step: str, work: Callable[[], Any], leaves: str | None = None) -> Any:
        """Do `work` and write down how long it took, and with which versions.

        Args:
            step: what the time is called.
            work: does it.
            leaves: the step of `OUTPUTS` whose files the work may find finished: where it changes none of them, it has
                done nothing, and no record changes.
        """
        before = self._marks(leaves)
        started = time.perf_counter()
        value = work()
        spent = time.perf_counter() - started
        if leaves is not None and self._marks(leaves) == before:
            return value
        summary = self.run.read_summary()
        timing = summary.get("timing", {})
        timing[step] = round(timing.get(step, 0.0) + spent, 3)
        made_with = {**summary.get("provenance", {}).get("steps", {}), step: _versions()}
        self.run.update_summary(timing=timing, provenance={**self._provenance(), "steps": made_with})
        configuration.save(self.config, self.run.config, _versions())
        return value

    def _marks(self, step: str | None) -> dict[Path, tuple[int, int]]:
        """Which files of a step there are, and as of when: size and time of change."""
        places = [self.run.path / name for name in (OUTPUTS[step] if step else ())]
        files = (path for place in places for path in ([place] if place.is_file() else place.rglob("*")))
        return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in files if path.is_file()}

    def _provenance(self) -> dict[str, Any]:
        return {
            "preset": self.config.preset,
            "domain": self.config.domain,
            "variant": self.config.variant,
            "seed": self.config.seed,
            "versions": _versions(),
            "machine": {
                "processor": platform.machine(),
                "cores": os.cpu_count(),
                "system": platform.system(),
            },
        }

    def collect(self) -> dict[str, Any]:
        """Collect experience."""
        from domains.core import TASKS, load_domain
        from nesy.log.collection import collect

        if not self.run.has("collect") or "experience" not in self.run.read_summary():
            domain = load_domain(self.config.domain)
            for task in sorted(set(TASKS) - set(domain.spec.tasks)):
                say(f"world '{domain.spec.name}' has no task '{task}': its episodes are left out")
            rows = self._timed(
                "collect",
                lambda: collect(
                    domain,
                    self.config.collect,
                    self.run.experience,
                    variant=self.config.variant,
                    seed=self.config.seed,
                    progress=self.progress,
                ),
            )
            write_json(self.run.experience / "complete.json", {"rows": rows})
            self.run.update_summary(experience={"rows": rows})
        return dict(self.run.read_summary()["experience"])

    def train(self) -> dict[str, Any]:
        """Train the world model."""
        self.run.require("collect")
        if not self.run.has("train") or "world_model" not in self.run.read_summary():
            from domains.core import load_domain
            from nesy.world_model import train

            domain = load_domain(self.config.domain)
            metrics = self._timed(
                "train",
                lambda: train(
                    self.run.experience,
                    self.config.train,
                    self.run.world_model,
                    seed=self.config.seed,
                    progress=self.progress,
                    domain=domain,
                    variant=self.config.variant,
                ),
            )
            self.run.update_summary(world_model=metrics)
        return dict(self.run.read_summary()["world_model"])

    def extract(self) -> dict[str, Any]:
        """Extract the 2DBN, and measure it: fidelity, perspective shift, what codes mean."""
        self.run.require("collect", "train")
        config = self.config
        if not self.run.has("extract") or "dbn" not in self.run.read_summary():
            from nesy.dbn import extract_run

            self._figures("dbn", "extract", lambda: extract_run(self.run, config.domain, config.extract))
        measured = self.run.read_summary()
        where = (self.run, config.domain, config.variant, config.seed)
        if "fidelity" not in measured["dbn"]:
            from nesy.dbn import fidelity_report

            fidelity = self._timed("fidelity", lambda: fidelity_report(*where))
            self.run.update_summary(dbn={**measured["dbn"], "fidelity": fidelity})
        if "perspective" not in measured:
            from nesy.perspective.gates import evaluate_run

            self._figures("perspective", "perspective", lambda: evaluate_run(*where, config.train.held_out))
        if "semantics" not in measured:
            from nesy.asp.semantics.run import semantics_report

            self._figures("semantics", "semantics", lambda: semantics_report(*where))
        return dict(self.run.read_summary()["dbn"])

    def _figures(self, section: str, timed_as: str, work: Callable[[], Any]) -> None:
        """Do `work` and store what it returns as a section of summary.json, with the time it took."""
        figures = self._timed(timed_as, work)
        self.run.update_summary(**{section: figures})

    def compare(self, engine: str = "local", address: str | None = None) -> dict[str, Any]:
        """Compare the agents, with an engine of `planners.comparison.engines`."""
        self.run.require("collect", "train", "extract")
        from planners.comparison.compare import compare

        cells = self._timed(
            "compare",
            lambda: compare(
                self.run,
                self.config.compare,
                domain_name=self.config.domain,
                seed=self.config.seed,
                jobs=self.jobs,
                progress=self.progress,
                engine=engine,
                address=address,
            ),
            leaves="compare",
        )
        self.run.update_summary(comparison=cells)
        write_json(self.run.results / "comparison.json", cells)
        self._timed("replays", self._record_replays, leaves="compare")
        return {"comparison": cells}

    def left_out(self) -> dict[str, str]:
        """Agents that the comparison has to do without, and why."""
        return dict(read_json(self.run.results / "statistics.json").get("left_out", {}))

    def _record_replays(self) -> None:
        """Play a few episodes of the comparison again for the report, unless that has been done."""
        from planners.comparison.replay.record import record_replays

        record_replays(self.run, self.config.compare, self.config.seed, self.progress, self.config.domain)

    def report(self) -> dict[str, Any]:
        """Write report.html."""
        from nesy.report.page import write_report

        self.run.require("collect", "train", "extract", "compare")
        self._timed("replays", self._record_replays, leaves="compare")  # a run compared by an earlier version has none
        path = self._timed("report", lambda: write_report(self.run, self.progress), leaves="report")
        return {"report": str(path)}


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "nesy": importlib.metadata.version("nesy")}
    for library in LIBRARIES:
        found[library] = importlib.metadata.version(library)
    return found


def say(message: str) -> None:
    """Tell the user something that is not the result: on standard error."""
    print(message, file=sys.stderr, flush=True)
