"""Caches of compiled kernels notice changes in other files."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from nesy import compiled

ROOT = Path(__file__).resolve().parents[2]


def test_every_kernel_carries_the_stamp() -> None:
    kernels = 0
    for path in compiled._kernel_files():
        if path.name == "compiled.py":
            continue
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for value in vars(importlib.import_module(name)).values():
            cache_file = getattr(getattr(value, "_cache", None), "_cache_file", None)
            if cache_file is not None and not getattr(value, "__module__", name).startswith("domains."):
                assert cache_file._source_stamp == compiled.STAMP, f"{name}: {value}"
                kernels += 1
    assert kernels > 10


def test_no_kernel_goes_around_the_stamp() -> None:
    for package in ("nesy", "planners"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if path.name != "compiled.py":
                assert "from numba import njit" not in path.read_text(encoding="utf-8"), path


@pytest.mark.parametrize("changed", [True, False])
def test_a_change_in_a_callee_is_noticed(tmp_path: Path, changed: bool) -> None:
    """A package of two files: after the callee's file has changed, its caller computes with the new one."""
    (tmp_path / "nesy").mkdir()
    (tmp_path / "planners").mkdir()
    (tmp_path / "nesy" / "__init__.py").touch()
    (tmp_path / "nesy" / "compiled.py").write_text((ROOT / "nesy" / "compiled.py").read_text())
    callee, caller = tmp_path / "nesy" / "callee.py", tmp_path / "nesy" / "caller.py"
    callee.write_text("from nesy.compiled import njit\n@njit(cache=True)\ndef one(x):\n    return x + 1\n")
    caller.write_text(
        "from nesy.compiled import njit\nfrom nesy.callee import one\n"
        "@njit(cache=True)\ndef two(x):\n    return one(x) * 2\nprint(two(1), sum(two.stats.cache_hits.values()))\n"
    )

    def run() -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", "import nesy.caller"], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return str(done.stdout).split()

    assert run()[0] == "4"
    if changed:
        callee.write_text(callee.read_text().replace("x + 1", "x + 10"))
        assert run()[0] == "22"
    else:
        assert run() == ["4", "1"]
