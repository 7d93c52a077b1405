"""A run killed in every step and resumed ends as the undisturbed run; two writers do not meet."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nesy.cli.main import main
from nesy.errors import UserError
from nesy.run_folder import RunFolder, atomic_path
from scripts.interrupted_runs import differences, finish, half_written, interrupt_when
from tests.conftest import TINY


@pytest.mark.slow
def test_a_run_killed_in_every_step_ends_as_the_undisturbed_run(tiny_run: Path, tmp_path: Path) -> None:
    if os.environ.get("NESY_TEST_RUN"):
        pytest.skip("the given run was made with other options")
    folder = tmp_path / "run"
    for pattern in ("experience/part-*.parquet", "world_model/metrics.jsonl", "results/cells/*.parquet"):
        status, _ = interrupt_when(folder, TINY, pattern)
        assert status == -signal.SIGKILL
        assert half_written(folder) == []
    status, said = interrupt_when(folder, TINY, "results/comparison.json", signal.SIGTERM)
    # It may have been done in time; and Python ends by the signal itself, which a shell reports as 130 too, where the
    # interrupt met code made by exec().
    assert status in (0, 130, -signal.SIGINT), said
    assert "Traceback" not in said
    status, said, _ = finish(folder, TINY)
    assert status == 0, said
    assert differences(tiny_run, folder) == []
    assert [path for path in folder.rglob(".*.tmp*") if path.is_file()] == []


def test_two_runs_that_differ_are_told_apart(tiny_run: Path, run_copy: Path) -> None:
    assert differences(tiny_run, run_copy) == []
    (run_copy / "dbn" / "model.json").write_bytes(b"{}")
    (run_copy / "results" / "comparison.json").unlink()
    found = differences(tiny_run, run_copy)
    assert found == ["only in one of the runs: results/comparison.json", "different: dbn/model.json"]
    (run_copy / "summary.json").write_text("{")
    assert [line.split(":")[0] for line in half_written(run_copy)] == ["summary.json"]


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    program = (
        "import os, signal, sys; from pathlib import Path; from nesy.run_folder import atomic_path\n"
        "with atomic_path(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    for name in ("results/episodes.parquet", "summary.json", "noending"):
        subprocess.run([sys.executable, "-c", program, str(run.path / name)], check=False)
    assert len([path for path in run.path.rglob(".*") if ".tmp" in path.name]) == 3
    (run.path / ".mine.tmp").write_text("not ours")
    with run.lock():
        left = sorted(path.name for path in run.path.rglob("*") if path.is_file())
    assert left == [".lock", ".mine.tmp"]


def test_a_second_writer_is_refused_and_a_reader_is_not(run_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFolder(run_copy)
    with run.lock():
        for command in (["collect"], ["report"], ["compare"]):
            assert main([*command, "--run", str(run_copy)]) == 2
            error = capsys.readouterr().err
            assert f"is being written by process {os.getpid()}" in error
        assert main(["query", "--run", str(run_copy), "--changes", "forward"]) == 0
        with atomic_path(run.summary) as temporary:
            temporary.write_text("{")  # half-written, and not to be seen
            assert run.read_summary()["provenance"]
            temporary.write_text("{}")
        assert run.read_summary() == {}


def test_the_lock_of_a_dead_process_does_not_hold(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys; from pathlib import Path; from nesy.run_folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).lock():\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    with RunFolder(tmp_path).lock(), pytest.raises(UserError), RunFolder(tmp_path).lock():
        pass
