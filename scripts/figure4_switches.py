"""Figure 4 again with the switches of the published code, one at a time: which of them decides the ranking?

    python scripts/figure4_switches.py --run runs/demo --output runs/figure4-switches --episodes 5000 --seeds 0 1 2

For every switch the three modes are learned with the preset and that one change (docs/notes/comparison.md says what
each is). Leaves switches.md and switches.json beside a folder for each switch; called again it goes on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import figure4
import tyro

from nesy.errors import UserError
from nesy.run_folder import atomic_path, write_json
from planners.config import LEARNERS, DQNConfig, LearnerName

SWITCHES: dict[str, dict[str, Any]] = {
    "corrected": {},
    "terminals": {"published_terminals": True},
    "target-start": {"published_target_start": True},
    "target-copied": {"target_period": 50},
    "fallback": {"fallback": "published"},
    "sampling": {"published_sampling": True},
    "occlusion": {"published_occlusion": True},
    "all": {
        "published_terminals": True,
        "published_target_start": True,
        "fallback": "published",
        "published_sampling": True,
        "published_occlusion": True,
    },
}


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """A run with a trained world model."""
    output: Path = Path("runs/figure4-switches")
    """Where everything goes; a folder for each switch."""
    switches: tuple[str, ...] = tuple(SWITCHES)
    """Which switches, each on its own; `all` together."""
    preset: LearnerName = "fast"
    """Settings of the learner to start from."""
    modes: tuple[str, ...] = figure4.MODES
    """Influence modes."""
    episodes: int = 5000
    """Training episodes."""
    final: int = 500
    """Training episodes at the end that the table is about."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds; every mode is learned once per seed."""
    jobs: int = 2
    """Processes."""


def main(options: Arguments) -> None:
    """Learn what is missing, and print the table."""
    found = {}
    for name in options.switches:
        if name not in SWITCHES:
            raise UserError(f"unknown switch '{name}' (known: {', '.join(SWITCHES)})")
        dqn: DQNConfig = LEARNERS[options.preset](options.episodes)
        found[name] = figure4.make(
            figure4.Arguments(
                run=options.run,
                output=options.output / name,
                episodes=options.episodes,
                seeds=options.seeds,
                modes=options.modes,
                final=options.final,
                jobs=options.jobs,
                dqn=replace(dqn, **SWITCHES[name]),
            )
        )
        write_json(options.output / "switches.json", found)
        with atomic_path(options.output / "switches.md") as temporary:
            temporary.write_text("\n".join(table(found, options.modes)) + "\n", encoding="utf-8")
    print("\n".join(table(found, options.modes)))


def table(found: dict[str, Any], modes: Sequence[str]) -> list[str]:
    """Lines of Markdown: what each mode returned in the end, and how the modes rank."""
    lines = [f"| switch | {' | '.join(modes)} | ranking |", "| --- |" + " --- |" * (len(modes) + 1)]
    for name, result in found.items():
        returns = [result["modes"][mode]["return"] for mode in modes]
        cells = [f"{r['mean']:.1f} [{r['low']:.1f}, {r['high']:.1f}]" for r in returns]
        lines.append(f"| {name} | {' | '.join(cells)} | {result['ranking'].partition(': ')[2].rstrip('.')} |")
    return lines


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except UserError as mistake:
        raise SystemExit(f"figure4_switches: {mistake}") from None
