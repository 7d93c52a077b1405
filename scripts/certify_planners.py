"""Certify the planners of explicit POMDPs against published values.

    python scripts/certify_planners.py [--problems tiger 4,4 5,5 7,8] [--episodes N] [--seconds S] [--json FILE]
    python scripts/certify_planners.py --discounts 0.9 0.999 0.9999 0.99999
    python scripts/certify_planners.py --files FOLDER [--time-limit 10] [--gap 1e-3] [--brackets FILE.csv] [--json FILE]

With `--discounts`: the solver's bounds where every step earns 1, which is worth 1 / (1 - discount).

With `--files`: the solver's bounds for every .pomdp file of a folder, and whether they are in order; with `--brackets`
(lines of file name, lower, upper; by another solver) also whether the two brackets overlap to within the gap.

Else, for each problem: the solver's bounds, and what acting on the online search is worth (exactly where every belief
that can come up can be enumerated, else the mean of episodes with a 95 % interval). Exit status 1 where a mark is
missed, bounds cross or brackets do not overlap.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from domains.classic import rocksample, tiger
from nesy.errors import UserError
from planners.explicit.point_based import solve
from planners.explicit.pomdp import CrossedBounds, TabularPOMDP
from planners.search.tree_search import TreeSearch, closed_loop, exact_return


@dataclass(frozen=True)
class Mark:
    """What a problem has to reach: published value, gap of the bounds, least return of the search, exactly or not."""

    value: float
    gap: float
    least: float
    exact: bool


@dataclass(frozen=True)
class Outcome:
    """What a problem reached; `error` is half the width of the 95 % interval, 0 for an exact value."""

    problem: str
    published: float
    lower: float
    upper: float
    solver_seconds: float
    search: float
    error: float
    decision_seconds: float
    passed: bool


MARKS = {
    "tiger": Mark(19.371, 1e-3, 0.98 * 19.371, True),
    "4,4": Mark(17.925, 0.05 * 17.925, 0.95 * 17.925, True),
    "5,5": Mark(19.237, 0.05 * 19.237, 0.95 * 19.237, False),
    "7,8": Mark(21.47, np.inf, 20.5, False),
}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", nargs="+", choices=list(MARKS), default=list(MARKS))
    parser.add_argument("--episodes", type=int, default=200, help="of problems whose beliefs cannot be enumerated")
    parser.add_argument("--seconds", type=float, default=1.0, help="per decision, for 7,8")
    parser.add_argument("--solver-seconds", type=float, default=120.0)
    parser.add_argument("--json", type=Path, default=None, help="also write the outcomes to this file")
    parser.add_argument("--files", type=Path, default=None, help="a folder of .pomdp files, or one file")
    parser.add_argument("--time-limit", type=float, default=10.0, help="seconds per file")
    parser.add_argument("--gap", type=float, default=1e-3, help="of the bounds, at which a file is done")
    parser.add_argument("--brackets", type=Path, default=None, help="CSV of another solver's bounds: file,lower,upper")
    parser.add_argument("--discounts", type=float, nargs="+", default=None, help="where every step earns 1")
    arguments = parser.parse_args()
    if arguments.discounts:
        return ones(arguments.discounts)
    if arguments.files:
        return sweep(arguments.files, arguments.time_limit, arguments.gap, arguments.brackets, arguments.json)
    outcomes = []
    print("| problem | published | solver's bounds (s) | search | s per decision | mark |")
    print("| --- | --- | --- | --- | --- | --- |")
    for problem in arguments.problems:
        done = certify(problem, arguments.episodes, arguments.seconds, arguments.solver_seconds)
        outcomes.append(asdict(done))
        spread = f" +- {done.error:.2f}" if done.error else " (exact)"
        print(
            f"| {problem} | {done.published:.3f} | {done.lower:.3f} to {done.upper:.3f} ({done.solver_seconds:.0f}) | "
            f"{done.search:.3f}{spread} | {done.decision_seconds:.3f} | {'met' if done.passed else 'MISSED'} |",
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")
    return 0 if all(outcome["passed"] for outcome in outcomes) else 1


def ones(discounts: list[float]) -> int:
    """Bounds where every step earns 1, one state and 30; 1 where they leave out 1 / (1 - discount)."""
    print("| discount | states | lower | upper | relative width | seconds |")
    print("| --- | --- | --- | --- | --- | --- |")
    wrong = False
    for discount in discounts:
        for states in (1, 30):
            rng = np.random.default_rng(0)
            model = TabularPOMDP(
                states=[str(s) for s in range(states)],
                actions=["0", "1"],
                observations=["0", "1"],
                transition=[rng.dirichlet(np.ones(states), states) for _ in range(2)],
                observation=rng.dirichlet(np.ones(2), (2, states)),
                reward=np.ones((2, states)),
                discount=discount,
                start=np.full(states, 1 / states),
                terminal=np.zeros(states, bool),
            )
            found, value = solve(model), 1 / (1 - discount)
            wrong |= not found.lower <= value <= found.upper
            width = (found.upper - found.lower) / value
            print(f"| {discount} | {states} | {found.lower!r} | {found.upper!r} | {width:.1g} | {found.seconds:.3f} |")
    return int(wrong)


def sweep(files: Path, time_limit: float, gap: float, brackets: Path | None, output: Path | None) -> int:
    """Solve every file and print a table; 1 where bounds cross or exclude the other solver's."""
    paths = sorted(files.glob("*.pomdp")) if files.is_dir() else [files]
    if not paths:
        print(f"{files}: no .pomdp files", file=sys.stderr)
        return 2
    others = _brackets(brackets) if brackets else {}
    print("| file | states, actions, observations | discount | bounds | seconds | verdict |")
    print("| --- | --- | --- | --- | --- | --- |")
    rows = []
    for path in paths:
        row = bounds_of(path, time_limit, gap, others.get(path.name))
        rows.append(row)
        bounds = "" if row["lower"] is None else f"{row['lower']:.7g} to {row['upper']:.7g}"
        cells = (path.name, row["sizes"], row["discount"], bounds, f"{row['seconds']:.2f}", row["verdict"])
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)
    if output:
        output.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return int(any(row["verdict"].isupper() for row in rows))


def bounds_of(path: Path, time_limit: float, gap: float, other: tuple[float, float] | None) -> dict[str, Any]:
    """The solver's bounds for a file; the verdict is in capitals where it is a failure."""
    row: dict[str, Any] = {
        "file": path.name,
        "sizes": "",
        "discount": None,
        "lower": None,
        "upper": None,
        "seconds": 0.0,
    }
    try:
        model = TabularPOMDP.from_file(path)
        row["sizes"] = f"{len(model.states)}, {len(model.actions)}, {len(model.observations)}"
        row["discount"] = model.discount
        found = solve(model, gap=gap, time_limit=time_limit)
    except UserError as error:
        return {**row, "verdict": f"refused: {error}"}
    except CrossedBounds:
        return {**row, "verdict": "CROSSED"}
    verdict = "closed" if found.upper - found.lower <= gap else "open"
    slack = max(gap, found.bounds.precision)
    if other and (found.lower > other[1] + slack or found.upper < other[0] - slack):
        verdict = "EXCLUDES THE OTHER BRACKET"
    return {**row, "lower": found.lower, "upper": found.upper, "seconds": found.seconds, "verdict": verdict}


def _brackets(path: Path) -> dict[str, tuple[float, float]]:
    with path.open(encoding="utf-8", newline="") as lines:
        return {name: (float(lower), float(upper)) for name, lower, upper in csv.reader(lines)}


def certify(problem: str, episodes: int, seconds: float, solver_seconds: float) -> Outcome:
    """Bounds and search of one problem."""
    mark = MARKS[problem]
    if problem == "tiger":
        model = TabularPOMDP(**tiger())
    else:
        size, rocks = map(int, problem.split(","))
        model = TabularPOMDP(**rocksample(size, rocks))
    certificate = solve(model, gap=min(mark.gap, 0.05 * mark.value), time_limit=solver_seconds)
    large = problem == "7,8"
    search = TreeSearch(
        model,
        np.random.default_rng(0),
        simulations=5000 if large else 200,
        time_limit=seconds if large else 0.0,
        trials=200 if large else 20,
        reuse=not mark.exact,
    )
    search.plan(model.start)  # compiles the kernels
    started = time.perf_counter()
    search.plan(model.start)
    decision = time.perf_counter() - started
    if mark.exact:
        reached, error = exact_return(search, least=1e-4), 0.0
    else:
        returns = [closed_loop(search, 100, np.random.default_rng([1, episode])) for episode in range(episodes)]
        reached, error = float(np.mean(returns)), 1.96 * float(np.std(returns) / np.sqrt(episodes))
    bracketed = certificate.lower <= mark.value + 5e-3 and certificate.upper >= mark.value - 5e-3
    return Outcome(
        problem=problem,
        published=mark.value,
        lower=certificate.lower,
        upper=certificate.upper,
        solver_seconds=certificate.seconds,
        search=reached,
        error=error,
        decision_seconds=decision,
        passed=bracketed and certificate.upper - certificate.lower <= mark.gap and reached + error >= mark.least,
    )


if __name__ == "__main__":
    sys.exit(main())
