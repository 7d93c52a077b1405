"""Damaged files of every kind: a clear line or a good load, never a traceback, a hang or code that runs."""

from __future__ import annotations

from pathlib import Path

from scripts.fuzz_loaders import fuzz, loaders


def test_loaders_take_mutated_files_well(tiny_run: Path) -> None:
    failures, tally = fuzz(tiny_run, count=260, seed=20)
    assert failures == []
    for loader in loaders():
        assert tally[loader.name] == 20
    # mutations do break files: else nothing is tested
    assert sum(tally[f"{loader.name}: loaded"] for loader in loaders()) < 200
