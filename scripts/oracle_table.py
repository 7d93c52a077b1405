"""Print the table that decides what comparisons can show: exact oracles and followers by variant.

    python scripts/oracle_table.py [--variants paper clean ...] [--json FILE] [--discount 0.99]

Every figure is exact for the instance named: all maps of the generator with their probabilities, and every
candidate goal. Returns are not discounted; the optima maximise the discounted return.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from domains.person_following import oracle_row

INSTANCES: dict[str, dict[str, Any]] = {
    "paper": {},
    "clean": {},
    "occluded": {"size": 9, "num_crossings": 1},
    "intent": {},
    "false_belief": {},
}
COLUMNS = ("full_state", "bayes", "egocentric", "egocentric_full_state", "greedy_follower", "greedy_last_seen")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", nargs="+", choices=sorted(INSTANCES), default=list(INSTANCES))
    parser.add_argument("--discount", type=float, default=None, help="left out: as the variant says")
    parser.add_argument("--max-beliefs", type=int, default=200_000, help="where each Bayes search stops")
    parser.add_argument("--json", type=Path, default=None, help="also write the rows to this file")
    arguments = parser.parse_args()
    rows = []
    print("| variant | worlds | " + " | ".join(name.replace("_", " ") for name in COLUMNS) + " |")
    print("| --- | --- |" + " --- |" * len(COLUMNS))
    for variant in arguments.variants:
        row = oracle_row(variant, discount=arguments.discount, max_beliefs=arguments.max_beliefs, **INSTANCES[variant])
        rows.append(row)
        cells = [_cell(row[name]) for name in COLUMNS]
        print(f"| {variant} {_changes(row['changes'])} | {row['worlds']} | " + " | ".join(cells) + " |", flush=True)
        if not row["bayes"]["solved"]:
            print(f"{variant}: the Bayes bounds did not meet: {row['bayes']}", file=sys.stderr)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _cell(result: dict[str, Any] | None) -> str:
    if result is None:
        return "-"
    return f"{result['return']:.1f}, {result['success']:.3f} ({result['seconds']:.1f} s)"


def _changes(changes: dict[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in changes.items())


if __name__ == "__main__":
    main()
