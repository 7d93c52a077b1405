"""Make golden.json again: python -m tests.golden.freeze [--run RUN] [--parts PART ...].

RUN is a finished run made with the options `TINY` of tests/conftest.py; without it one is made first.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from tests.conftest import TINY
from tests.golden.measure import PARTS, machine

GOLDEN = Path(__file__).with_name("golden.json")


@dataclass(frozen=True)
class Arguments:
    """Options."""

    run: Path | None = None
    """A run made with the options TINY of tests/conftest.py."""
    parts: tuple[str, ...] = tuple(PARTS)
    """What to measure; the rest of golden.json stays."""


def main() -> None:
    """Measure everything and write it."""
    options = tyro.cli(Arguments, description=__doc__)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        run = options.run
        if run is None:
            from nesy.cli.main import main as nesy

            run = work / "run"
            assert nesy(["run", "--run", str(run), *TINY]) == 0
        for part in options.parts:
            started = time.perf_counter()
            (work / part).mkdir()
            measured = PARTS[part](run, work / part)
            print(f"{part}: {time.perf_counter() - started:.1f} s", flush=True)
            golden = json.loads(GOLDEN.read_text(encoding="utf-8")) if GOLDEN.is_file() else {}
            golden |= {"machine": machine(), part: measured}
            GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
