"""Coverage-guided fuzzing finds nothing in the loaders, and does find what is there to be found."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.fuzz
ROOT = Path(__file__).parents[2]


def test_a_loader_is_fuzzed(tiny_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "scripts/fuzz_atheris.py", "--run", str(tiny_run), "--runs", "60"]
    command += ["--only", "config.json", "--keep", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "60 inputs" in done.stdout and "nothing found" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_bad_loader_is_found_out(tiny_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    broken = (
        "import sys; sys.argv = ['fuzz']; from pathlib import Path; from scripts import fuzz_atheris, fuzz_loaders\n"
        "bad = fuzz_loaders.Loader('config.json', ('config.json',),"
        " lambda root: (root / 'config.json').read_bytes().index(b'preset'))\n"
        "fuzz_loaders.loaders = lambda: (bad,)\n"
        f"fuzz_atheris.fuzz_one('config.json', Path({str(tiny_run)!r}), 2000, 0, Path({str(tmp_path)!r}))\n"
    )
    done = subprocess.run([sys.executable, "-c", broken], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode != 0
    assert "ValueError: subsection not found" in done.stdout + done.stderr
    assert list(tmp_path.iterdir())
