"""The process that grounds and solves one program; run as a script, with limits on what it may use.

Reads one JSON object from standard input: `files` (paths of program texts), `facts` (the path of another), `hidden`
(names of predicates not to print unless a program has #show), `models` (how many; 0 for all), `time_limit` in seconds,
`memory_mb`, `core_guided` (how an optimum is looked for). Writes JSON lines: `{"model": [atoms], "cost": [...]}` for
every model and at the end `{"result": ...}` or `{"error": text}`. Imports nothing of the project: it must start at
once.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from typing import Any

MAX_OUTPUT = 64 << 20
PATIENCE = 0.2
"""Seconds spent on whether there are further models once those asked for are found."""


def main() -> None:
    """Solve what standard input describes."""
    task = json.load(sys.stdin)
    # one thread's stack and clingo itself need some address space besides the limit asked for
    memory = int(task["memory_mb"]) << 20
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    seconds = int(task["time_limit"]) + 5
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        _solve(task)
    except MemoryError:
        _write({"error": f"the program needs more than {task['memory_mb']} MB", "kind": "memory"})
    except Exception as error:
        _write({"error": f"the solver failed ({error})", "kind": "solver"})


def _solve(task: dict[str, Any]) -> None:
    import clingo
    from clingo import ast

    messages: list[tuple[str, str]] = []

    def log(code: Any, message: str) -> None:
        if len(messages) < 50:
            messages.append((code.name, message))

    started = time.monotonic()
    strategy = ["--opt-strategy=usc"] if task["core_guided"] else []
    control = clingo.Control(["--opt-mode=optN", f"--models={task['models'] + 1}", *strategy], logger=log)
    has_show = False
    try:
        with ast.ProgramBuilder(control) as builder:

            def add(statement: Any) -> None:
                nonlocal has_show
                if statement.ast_type == ast.ASTType.Script:
                    raise PermissionError(f"{statement.location.begin.filename}: script blocks are not allowed")
                shows = (ast.ASTType.ShowSignature, ast.ASTType.ShowTerm)
                has_show = has_show or statement.ast_type in shows
                builder.add(statement)

            ast.parse_files(task["files"], add, logger=log)
        control.load(task["facts"])
        control.ground([("base", [])])
    except PermissionError as error:
        _write({"error": str(error), "kind": "program"})
        return
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, MemoryError) or "bad_alloc" in str(error):
            raise MemoryError from None
        text = "; ".join(message for _, message in messages) or str(error)
        _write({"error": text, "kind": "program"})
        return
    grounded = time.monotonic()
    _write({"grounded": grounded - started})
    hidden = set() if has_show else set(task["hidden"])
    written = 0
    best: dict[str, Any] | None = None
    found = 0
    deadline = started + float(task["time_limit"])
    # models are asked for one by one: between two of them, and while waiting, the deadline is looked at
    with control.solve(yield_=True, async_=True) as handle:
        stopped = more = False
        while True:
            handle.resume()
            if not handle.wait(max(0.0, deadline - time.monotonic())):
                handle.cancel()
                # the answers asked for are there: whether there are more is not worth waiting for
                stopped = found < task["models"]
                more = True
                break
            model = handle.model()
            if model is None:
                break
            if found == task["models"]:
                handle.cancel()
                more = True
                break
            atoms = sorted(
                str(symbol)
                for symbol in model.symbols(shown=True)
                if not (symbol.type == clingo.SymbolType.Function and symbol.name in hidden)
            )
            line = {"model": atoms, "cost": list(model.cost)}
            # while an optimum is searched for, only the best model so far is kept
            if model.cost and not model.optimality_proven:
                best = line
                continue
            best = None
            found += 1
            written += _write(line)
            if found == task["models"]:
                deadline = min(deadline, time.monotonic() + PATIENCE)
            if written > MAX_OUTPUT:
                _write({"error": f"the answers are longer than {MAX_OUTPUT >> 20} MB", "kind": "output"})
                return
        if best is not None:
            _write(best)
        result = handle.get()
    statistics = control.statistics
    _write(
        {
            "result": {
                "satisfiable": True if found or best is not None else result.satisfiable,
                "exhausted": bool(result.exhausted) and not more,
                "optimal": found > 0,
                "stopped": stopped,
                "ground_s": grounded - started,
                "solve_s": time.monotonic() - grounded,
                "rules": int(statistics["problem"]["lp"]["rules"]),
                "atoms": int(statistics["problem"]["lp"]["atoms"]),
                "messages": [message for _, message in messages],
            }
        }
    )


def _write(value: dict[str, Any]) -> int:
    text = json.dumps(value)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
    return len(text)


if __name__ == "__main__":
    main()
