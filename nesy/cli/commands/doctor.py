"""Check the installation, a run folder (--run) or a world (--world); say what to do about whatever is wrong."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nesy.errors import UserError

Verdict = Literal["good", "note", "bad"]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")
LEAST_ROOM = 500_000_000
"""Bytes free on the disk that a run asks for."""


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy doctor`."""

    run: Path | None = None
    """A run folder to check as well."""
    world: str | None = None
    """A world to check as well, package.module:ATTRIBUTE: its parts, and every step of nesy run for a moment."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


@dataclass(frozen=True)
class Check:
    """What was found about one thing."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


def run(options: Arguments) -> dict[str, Any]:
    """Make all checks.

    Raises:
        UserError: something is bad; the checks are printed all the same.
    """
    checks = list(_installation())
    if options.run is not None:
        checks += _run_folder(options.run)
    if options.world is not None:
        checks += _world(options.world)
    result = {"checks": [vars(check) for check in checks], "bad": sum(check.verdict == "bad" for check in checks)}
    if result["bad"]:
        if options.json:
            print(json.dumps(result))
        else:
            show(result)
        raise UserError(f"{result['bad']} of {len(checks)} checks found something bad; what to do is said above")
    return result


def show(result: dict[str, Any]) -> None:
    """Print one line per check, and what to do below those that need it."""
    for check in result["checks"]:
        mark = {"good": "ok  ", "note": "note", "bad": "BAD "}[check["verdict"]]
        print(f"{mark}  {check['what']}: {check['found']}")
        if check["advice"]:
            print(f"      {check['advice']}")


# ---------------------------------------------------------------- installation
def _installation() -> Iterator[Check]:
    new = sys.version_info >= (3, 11)
    advice = "" if new else "Python 3.11 or newer is needed: make PYTHON=/path/to/python3"
    yield Check("Python", "good" if new else "bad", platform.python_version(), advice)
    yield from _libraries()
    yield Check("processors", "good", f"{os.cpu_count()}; use as many with --jobs")
    for what, check in (("PyTorch", _torch), ("numba", _numba), ("clingo", _clingo), ("pomdp-py", _pomdp_py)):
        yield _tried(what, check)
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    yield Check("browser", "good" if browser else "note", browser or "none found",
                "" if browser else "report.html opens in any browser, also on another machine")  # fmt: skip


def _libraries() -> Iterator[Check]:
    """Versions of what pyproject.toml asks for."""
    from packaging.requirements import Requirement

    wrong, count = [], 0
    for text in importlib.metadata.requires("nesy") or []:
        needed = Requirement(text)
        if needed.marker is not None and not needed.marker.evaluate({"extra": ""}):
            continue
        count += 1
        try:
            found = importlib.metadata.version(needed.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{needed.name} is missing")
            continue
        if not needed.specifier.contains(found, prereleases=True):
            wrong.append(f"{needed.name} {found} is not {needed.specifier}")
    advice = "install again: .venv/bin/pip install -c constraints.txt -e ." if wrong else ""
    yield Check("libraries", "bad" if wrong else "good", "; ".join(wrong) or f"all {count} as needed", advice)


def _tried(what: str, check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:  # whatever a broken library raises is the finding
        reason = f"does not work ({type(error).__name__}: {str(error)[:160]})"
        return Check(what, "bad", reason, "install again: .venv/bin/pip install -c constraints.txt -e .")


def _torch() -> Check:
    import torch

    devices = ["cpu"] + [f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in range(torch.cuda.device_count())]
    total = float(torch.ones(8).sum())
    assert total == 8.0, f"adds up to {total}"
    return Check(
        "PyTorch", "good", f"{torch.__version__} on {', '.join(devices)}; the models here are small: cpu is used"
    )


def _numba() -> Check:
    """A kernel compiles, and its cache can be written: else every command compiles anew."""
    import numba

    import nesy.compiled

    folder = os.environ.get("NUMBA_CACHE_DIR") or str(Path(nesy.compiled.__file__).parent / "__pycache__")
    assert numba.njit(lambda x: x + 1)(1) == 2
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        advice = "set NUMBA_CACHE_DIR to a folder that you can write; without it every command compiles for a minute"
        return Check("numba", "bad", f"{numba.__version__}, but no cache in {folder} ({error.strerror})", advice)
    return Check("numba", "good", f"{numba.__version__}, compiles, cache can be written")


def _clingo() -> Check:
    import clingo

    control = clingo.Control(["0"])
    control.add("base", [], "{a; b}. :- not a, not b.")
    control.ground([("base", [])])
    with control.solve(yield_=True) as handle:
        count = sum(1 for _ in handle)
    assert count == 3, f"finds {count} models instead of 3"
    return Check("clingo", "good", f"{clingo.__version__}, solves")


def _pomdp_py() -> Check:
    import pomdp_py

    assert callable(pomdp_py.POUCT)
    return Check("pomdp-py", "good", importlib.metadata.version("pomdp-py"))


# ---------------------------------------------------------------- a world
def _world(name: str) -> Iterator[Check]:
    """What `check_domain` finds, and whether a run goes through."""
    from domains import check_domain
    from domains.core import load_domain

    def parts() -> str:
        report = check_domain(load_domain(name))
        lacking = f"; left out: {', '.join(report.left_out)}" if report.left_out else ""
        return f"{report.name}, {report.episodes} episodes played{lacking}"

    checked = _readable(f"world {name}", parts, "docs/new-domain.md says what a world has to have")
    yield checked
    if checked.verdict == "good":
        what, advice = "nesy run there", "this is a gap in check_domain: please tell us"
        try:
            yield Check(what, "good", _moment(name))
        except UserError as error:
            yield Check(what, "bad", str(error)[:300])
        except Exception as error:  # whatever it is, it is the finding
            yield Check(what, "bad", f"{type(error).__name__}: {str(error)[:250]}", advice)


def _moment(name: str) -> str:
    """All steps of the pipeline with next to nothing to do, in a folder that is gone afterwards."""
    from dataclasses import replace

    from domains.core import load_domain
    from nesy.cli.configuration import PRESETS
    from nesy.cli.pipeline import Pipeline
    from nesy.progress import SILENT

    variant = load_domain(name).spec.variants[0]
    base = PRESETS["smoke"]
    compare = replace(
        base.compare,
        agents=("dqn", "pomdp", "greedy-follower", "random"),
        influences=("perspective-shift",),
        variants=(variant,),
        episodes=2,
        planner_episodes=1,
        dqn=replace(base.compare.dqn, episodes=5),
    )
    config = replace(base, domain=name, variant=variant, compare=compare, train=replace(base.train, epochs=1))
    with tempfile.TemporaryDirectory(prefix="nesy-") as folder:
        work = Pipeline(Path(folder) / "run", config, 1, SILENT)
        work.configure()
        for step in (work.collect, work.train, work.extract, work.compare, work.report):
            step()
        played = ", ".join(dict.fromkeys(record["agent"] for record in work.run.read_summary()["comparison"]))
    return f"goes through; agents compared: {played}"


# ---------------------------------------------------------------- a run folder
def _run_folder(path: Path) -> Iterator[Check]:
    from nesy.run_folder import STEPS, RunFolder

    try:
        folder = RunFolder.open(path)
    except UserError as error:
        yield Check("run folder", "bad", str(error), "")
        return
    missing = [step for step in STEPS if not folder.has(step)]
    yield Check("steps", "note" if missing else "good", f"missing: {', '.join(missing)}" if missing else "all done",
                f"go on with: nesy run --run {path}" if missing else "")  # fmt: skip
    if not os.access(path, os.W_OK):
        yield Check("writable", "note", "no", "the run can be read but not gone on with")
    room = shutil.disk_usage(path).free
    yield Check("room on the disk", "good" if room > LEAST_ROOM else "note", f"{room / 1e9:.1f} GB free",
                "" if room > LEAST_ROOM else "a run takes up to 0.5 GB")  # fmt: skip
    yield from _files(folder, missing)
    yield _versions_of(folder)


def _files(folder: Any, missing: list[str]) -> Iterator[Check]:
    """Every file that a step left, read and checked as the step's reader does; checksums included."""
    from nesy.cli import configuration
    from nesy.run_folder import STEPS

    def collect() -> str:
        from nesy.log.experience import Experience

        return f"{len(Experience.load(folder.experience)):,} transitions"

    def train() -> str:
        from nesy.world_model import load_world_model

        return f"{sum(p.numel() for p in load_world_model(folder.world_model).parameters()):,} weights"

    def extract() -> str:
        from nesy.dbn import Codebook, TwoSliceDBN

        dbn, book = TwoSliceDBN.load(folder.dbn), Codebook.load(folder.dbn)
        return f"{len(dbn.probabilities):,} rows, {len(book):,} views; checksums fit"

    def compare() -> str:
        import pyarrow.parquet as pq

        from planners.comparison.replay.record import load_replays
        from planners.dqn.dqn import DQNPolicy
        from planners.person_following.ialm import IALM

        policies = [DQNPolicy.load(path) for path in sorted(folder.policies.glob("*.safetensors"))]
        if (folder.ialm / "model.json").is_file():
            IALM.load(folder.ialm)
        rows = pq.read_table(folder.results / "episodes.parquet").num_rows
        replays = folder.results / "replays.json"
        shown = len(load_replays(replays)["episodes"]) if replays.is_file() else 0
        return f"{rows:,} episodes, {len(policies)} policies, {shown} replays"

    def summary() -> str:
        sections = folder.read_summary()
        lacking = {"world_model", "dbn", "comparison", "timing", "provenance"} - set(sections)
        if lacking and not missing:
            raise UserError(f"summary.json lacks {', '.join(sorted(lacking))}")
        return f"{len(sections)} sections"

    def config() -> str:
        from domains.core import load_domain

        made = configuration.load(folder.config)
        return f"preset {made.preset}, world {load_domain(made.domain).spec.name}"

    readers: dict[str, Callable[[], str]] = {
        "config": config, "collect": collect, "train": train, "extract": extract, "compare": compare,
    }  # fmt: skip
    for step, reader in readers.items():
        if step in missing:
            continue
        advice = f"make it again: {STEPS[step][1]} --run {folder.path}" + (" --redo" if step != "config" else "")
        yield _readable(f"files of {step}", reader, advice)
    yield _readable("summary.json", summary, f"make it again: nesy run --run {folder.path} --redo")


def _readable(what: str, reader: Callable[[], str], advice: str) -> Check:
    try:
        return Check(what, "good", reader())
    except (UserError, OSError, ValueError, KeyError) as error:
        return Check(what, "bad", str(error)[:300], advice)


def _versions_of(folder: Any) -> Check:
    """Results repeat to the last digit only with the versions that made them."""
    from nesy.run_folder import read_json

    try:
        made = dict(read_json(folder.config).get("versions", {}))
    except (UserError, AttributeError, TypeError, ValueError) as error:
        return Check("versions", "bad", str(error)[:300])
    changed = []
    for name, version in made.items():
        now = platform.python_version() if name == "python" else _installed(name)
        if now != version:
            changed.append(f"{name} {version}, now {now}")
    advice = "what is there stays readable; steps made anew may differ in the last digits" if changed else ""
    return Check("versions", "note" if changed else "good", "; ".join(changed) or "as when the run was made", advice)


def _installed(name: str) -> str:
    try:
        return importlib.metadata.version(str(name))
    except importlib.metadata.PackageNotFoundError:
        return "missing"
