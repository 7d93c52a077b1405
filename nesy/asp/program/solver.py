"""Runs ASP programs in a process of their own, with limits on time, memory and answers.

A program from a stranger can ground without end, which nothing inside the process can interrupt. So every
such program gets a process that is killed at its limit; interrupting the caller kills it too.
"""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nesy.asp.program.sources import Source
from nesy.errors import UserError

WORKER = Path(__file__).with_name("worker.py")
MAX_MODELS = 100_000


@dataclass(frozen=True)
class Answer:
    """What the solver found."""

    satisfiable: bool | None
    """Whether there is a model; None where the time ran out before that was known."""
    models: tuple[tuple[str, ...], ...]
    """The shown atoms of each model found, sorted."""
    costs: tuple[tuple[int, ...], ...]
    """The cost of each model, by priority; empty tuples where the program optimises nothing."""
    optimal: bool
    """Whether the models are proven best (always true for a program that optimises nothing)."""
    exhausted: bool
    """Whether the search space was searched to its end: there are no further models."""
    dropped: float
    """Largest probability mass that the facts leave out of a table row; 0 where no such facts are used."""
    seconds: dict[str, float]
    """Wall time: `ground`, `solve`, `total`."""
    notes: tuple[str, ...] = ()
    """The solver's remarks, for example about predicates that nothing defines."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def solve(
    programs: Sequence[Source],
    facts: str,
    hidden: Sequence[str],
    *,
    models: int = 1,
    time_limit: float = 10.0,
    memory_mb: int = 2048,
    dropped: float = 0.0,
    core_guided: bool = False,
) -> Answer:
    """Ground and solve programs together with facts.

    Args:
        programs: the programs, already checked (see nesy.asp.program.sources).
        facts: facts as text.
        hidden: names of predicates left out of the models, unless a program has a #show statement.
        models: how many models at most; 0 for all (up to 100,000).
        time_limit: seconds for grounding and solving together.
        memory_mb: memory of the solving process.
        dropped: handed on to the answer.
        core_guided: whether an optimum is looked for from below (by unsatisfiable cores) instead of from above.

    Raises:
        UserError: the program is wrong (with file, line and column), or does not ground within its limits.
    """
    if models < 0 or time_limit <= 0 or memory_mb < 64:
        raise UserError("models must be at least 0, the time limit positive, the memory at least 64 MB")
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="nesy-asp-") as folder:
        names = _write_programs(Path(folder), programs, facts)
        task = {
            "files": [path for path, name in names.items() if name != "facts"],
            "facts": str(Path(folder) / "facts.lp"),
            "hidden": list(hidden),
            "models": min(models, MAX_MODELS) or MAX_MODELS,
            "time_limit": time_limit,
            "memory_mb": memory_mb,
            "core_guided": core_guided,
        }
        lines, complaints, killed, status = _run(task, started + time_limit + 0.5)
    records = _records(lines)
    problem = next((record for record in records if "error" in record), None)
    subject = next((source.name for source in reversed(programs) if not source.own), "program")
    if problem is not None:
        text = _readable(problem["error"], names, programs)
        raise UserError(text if problem["kind"] == "program" else f"{subject}: {text}")
    found = [record for record in records if "model" in record]
    result = next((record["result"] for record in records if "result" in record), None)
    if result is None and killed and not any("grounded" in record for record in records):
        raise UserError(
            f"{subject}: not grounded within {time_limit:g} s; "
            "its rules have too many instances (bound its variables) or the limit is too short"
        )
    if result is None and not killed:
        raise UserError(f"{subject}: {_ended(status, complaints, memory_mb)}")
    if result is None:
        result = {"satisfiable": True if found else None, "exhausted": False, "optimal": False, "messages": []}
    costs = tuple(tuple(int(c) for c in record["cost"]) for record in found)
    return Answer(
        satisfiable=result["satisfiable"],
        models=tuple(tuple(record["model"]) for record in found),
        costs=costs,
        optimal=bool(result["optimal"]) or not any(costs),
        exhausted=bool(result["exhausted"]),
        dropped=dropped,
        seconds={
            "ground": round(result.get("ground_s", time_limit), 4),
            "solve": round(result.get("solve_s", 0.0), 4),
            "total": round(time.monotonic() - started, 4),
        },
        notes=tuple(_readable(message, names, programs) for message in result["messages"]),
    )


def _write_programs(folder: Path, programs: Sequence[Source], facts: str) -> dict[str, str]:
    names = {}
    for number, source in enumerate(programs):
        path = folder / f"{number}.lp"
        path.write_text(source.text, encoding="utf-8")
        names[str(path)] = source.name
    (folder / "facts.lp").write_text(facts, encoding="utf-8")
    names[str(folder / "facts.lp")] = "facts"
    return names


def _run(task: dict[str, Any], deadline: float) -> tuple[str, str, bool, int]:
    """Output and error output of the worker, whether it had to be killed, and its exit status."""
    process = subprocess.Popen(
        [sys.executable, "-I", str(WORKER)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,
    )
    killed = False
    try:
        try:
            output, complaints = process.communicate(json.dumps(task), timeout=max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            killed = True
            output, complaints = process.communicate()
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        process.wait()
    return output, complaints, killed, process.returncode


def _records(lines: str) -> list[dict[str, Any]]:
    records = []
    for line in lines.splitlines():
        # the last line of a killed process may be cut off
        with contextlib.suppress(json.JSONDecodeError):
            records.append(json.loads(line))
    return records


def _ended(status: int, complaints: str, memory_mb: int) -> str:
    """Why the worker ended without a result."""
    if "bad_alloc" in complaints or "MemoryError" in complaints:
        return f"the program needs more than {memory_mb} MB"
    if status == -signal.SIGSEGV:
        return f"the solver crashed: terms become nested too deep, or need more than {memory_mb} MB"
    if status < 0:
        return f"the solver was ended by the signal {signal.Signals(-status).name}"
    last = (complaints.strip().splitlines() or ["no message"])[-1]
    return f"the solver ended without an answer (status {status}: {last[:200]})"


def _readable(message: str, names: dict[str, str], programs: Sequence[Source]) -> str:
    """A message of the solver's as one line that names the user's files, with columns in characters."""
    for (path, name), source in zip(names.items(), (*programs, None), strict=True):
        if source is not None and not source.text.isascii():

            def place(match: re.Match[str], path: str = path, source: Source = source) -> str:
                line = int(match[1])
                columns = [str(source.column(line, int(column))) for column in filter(None, match.groups()[1:])]
                return f"{path}:{line}:{'-'.join(columns)}"

            message = re.sub(rf"{re.escape(path)}:(\d+):(\d+)(?:-(\d+)(?!\d|:\d))?", place, message)
        message = message.replace(path, name)
    return re.sub(r"\s+", " ", message).strip()
