"""What is frozen: everything comes from commands, so that modules can move and agents be renamed.

`figures(run, work)` works on a finished small run (the fixture `tiny_run`) and on copies of it under `work`.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SMALL = {"inputs": ("full",), "influences": ("perspective-shift",)}
DQN = {"episodes": 96, "num_envs": 16, "warm_up": 64}
PAPER = ("search", "qmdp", "pomdp", "greedy-follower", "greedy-last-seen", "random", "optimum", "bayes-optimum", "dqn")
OTHERS = ("structured", "greedy-follower", "greedy-last-seen", "random")
COMPARISONS = (
    ("paper", PAPER, {"episodes": 42, "planner_episodes": 3}, 300),
    ("intent", OTHERS, {"episodes": 6, "planner_episodes": 2}, 300),
    ("false_belief", OTHERS, {"episodes": 6, "planner_episodes": 2}, 1000),
    ("occluded", OTHERS, {"episodes": 6, "planner_episodes": 3}, 100),
)
"""Variant, agents, settings, practice episodes."""
FIGURE4 = ("--episodes", "40", "--seeds", "0", "--final", "20", "--dqn.num-envs", "8", "--dqn.warm-up", "64")
RULES = "forbidden(forward) :- now(wall_ahead).\nforbidden(forward) :- now(person_ahead).\n"
PROGRAM = """candidate(I,C) :- holds(I,wall_ahead), holds(I,goal_visible), seen(I,C).
best(I,C) :- candidate(I,C), C = #max { D : candidate(_,D) }.
changes(F) :- changed(_,F,C), C > 0.
#show best/2.
#show changes/1.
"""
QUESTIONS = (
    "--means 3=5",
    "--changes forward",
    "--predicate wall_ahead",
    "--when goal_visible",
    "--when 3=5",
    "--verify forward --premise wall_ahead --conclusion same --codes met --least 0.01",
    "--plan wall_ahead --start 18",
    "--trajectory goal_visible --start 5 --max-steps 5",
    "--reach goal_visible --start 5",
    "--after left left --start 17",
    "--explain forward --start 17",
    "--knows goal_visible wall_ahead --views 1 2 3",
    "--knows goal_visible --start 17 --person 0,2,1",
    "--shield --rules rules.lp --start 17 --person 0,1,1",
    "--program program.lp",
)


def answer(*arguments: str) -> Any:
    """What a command of `nesy` prints with --json.

    Raises:
        AssertionError: it failed.
    """
    from nesy.cli.main import main

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        status = main([*arguments])
    assert status == 0, f"nesy {' '.join(arguments)}: exit status {status}"
    return json.loads(printed.getvalue())


def gates(run: Path, work: Path) -> dict[str, Any]:
    """Experience, gates of the world model, measures of the table, of the shift and of the rules."""
    summary = json.loads((run / "summary.json").read_text())
    sections = {name: summary[name] for name in ("experience", "world_model", "dbn", "perspective", "semantics")}
    return dict(short(without(sections, "seconds", "each")))


def table(run: Path, work: Path) -> dict[str, Any]:
    """The 2DBN as its Parquet file has it, by action and factor.

    `met`: how many rows were met, and how often all together. `most`: the row met most often, as its parents' values,
    count and probabilities. `counts`: digest of all counts. `sum`: of p (1 + k) over all rows and values k.
    """
    import pyarrow.parquet as pq

    folder = Path(shutil.copytree(run, work / "table"))
    answer("extract", "--run", str(folder), "--to", str(work / "table.parquet"), "--json")
    file = pq.ParquetFile(work / "table.parquet")
    found: dict[str, Any] = {}
    for group in range(file.num_row_groups):  # one for every action and factor
        part = file.read_row_group(group)
        value, probability, count = (part[name].to_numpy() for name in ("value", "probability", "count"))
        width = int(value.max()) + 1
        rows, counts = probability.reshape(-1, width), count[::width]
        most = int(counts.argmax())
        name = f"{part['action'][0].as_py()} {part['factor'][0].as_py()}"
        assert name not in found
        found[name] = {
            "parents": part["parents"][0].as_py(),
            "rows": len(rows),
            "met": [int((counts > 0).sum()), int(counts.sum())],
            "most": [part["parent_values"][most * width].as_py(), int(counts[most]), rows[most].tolist()],
            "counts": hashlib.sha256(counts.tobytes()).hexdigest()[:16],
            "sum": float((probability * (1.0 + value)).sum()),
        }
    return found


def questions(run: Path, work: Path) -> dict[str, Any]:
    """Answers to the questions: the text and what supports it."""
    files = {"rules.lp": RULES, "program.lp": PROGRAM}
    for name, text in files.items():
        (work / name).write_text(text)
    found = {}
    for question in QUESTIONS:
        words = [str(work / word) if word in files else word for word in question.split()]
        told = answer("query", "--run", str(run), *words, "--json")
        if "models" in told:
            found[question] = {"models": [sorted(model) for model in told["models"]]}
        else:
            support = [[str(end).replace(f"{work}/", "") for end in edge] for edge in told["support"]]
            found[question] = {"text": told["text"].replace(f"{work}/", ""), "support": short(support)}
    return found


def returns(run: Path, work: Path) -> dict[str, Any]:
    """What every agent got in every episode, on every variant; without the replays that `nesy compare` adds."""
    from nesy.run_folder import RunFolder
    from planners.comparison.compare import compare
    from planners.config import CompareConfig, DQNConfig, SearchConfig

    folder = Path(shutil.copytree(run, work / "returns"))
    found = {}
    for variant, agents, settings, practice in COMPARISONS:
        search = SearchConfig(simulations=30, pomdp_py_simulations=4, practice_episodes=practice)
        sizes = {**SMALL, **settings, "dqn": DQNConfig(**DQN), "search": search}
        compare(RunFolder(folder), CompareConfig(variants=(variant,), agents=agents, **sizes))
        found |= played(folder)
    return found


def figure4(run: Path, work: Path) -> dict[str, Any]:
    """What the command of figure 4 leaves, without the time it took, and its episodes."""
    arguments = [str(ROOT / "scripts" / "figure4.py"), "--run", str(run), "--output", str(work / "figure4")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *arguments, "--jobs", "1", *FIGURE4]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment, cwd=ROOT)
    result = json.loads((work / "figure4" / "figure4.json").read_text())
    return {name: value for name, value in result.items() if name != "seconds"} | {"played": played(work / "figure4")}


def played(folder: Path) -> dict[str, Any]:
    """Return, success and length of the evaluation episodes of a comparison, by variant and agent."""
    import pyarrow.parquet as pq

    found: dict[str, Any] = {}
    for row in pq.read_table(folder / "results" / "episodes.parquet", filters=[("phase", "=", "eval")]).to_pylist():
        variant = found.setdefault(row["variant"], {})
        name = " ".join(word for word in (row["agent"], row["influence"]) if word)
        agent = variant.setdefault(name, {"returns": [], "steps": [], "outcomes": []})
        agent["returns"].append(round(row["return"], 9))
        agent["steps"].append(row["length"])
        agent["outcomes"].append(row["outcome"])
    return dict(short(found))


PARTS: dict[str, Callable[[Path, Path], dict[str, Any]]] = {
    "gates": gates,
    "table": table,
    "questions": questions,
    "returns": returns,
    "figure4": figure4,
}
"""What is measured on a run, with a folder to work in."""


def without(value: Any, *names: str) -> Any:
    """JSON values without the entries of some names."""
    if isinstance(value, list):
        return [without(item, *names) for item in value]
    if not isinstance(value, dict):
        return value
    return {name: without(item, *names) for name, item in value.items() if name not in names}


def short(value: Any) -> Any:
    """A value with its long lists cut to their first eight items, with the length and the sum or digest of all."""
    if isinstance(value, dict):
        return {name: short(item) for name, item in value.items()}
    if not isinstance(value, list) or len(value) <= 8:
        return value
    numbers = all(isinstance(item, int | float) for item in value)
    whole = sum(value) if numbers else hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]
    return {"first": value[:8], "length": len(value), "sum" if numbers else "digest": whole}


def machine() -> dict[str, str]:
    """What the last bits of trained networks depend on."""
    from importlib.metadata import version

    import torch

    names = ("torch", "numpy", "numba", "scipy")
    return {"vectors": torch.backends.cpu.get_cpu_capability(), **{name: version(name) for name in names}}
