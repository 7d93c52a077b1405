"""`nesy doctor` finds what is damaged and says what to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nesy.cli.main import main


def test_a_good_installation_and_run(tiny_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--run", str(tiny_run), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["bad"] == 0
    found = {check["what"]: check for check in result["checks"]}
    for what in (
        "Python",
        "libraries",
        "PyTorch",
        "numba",
        "clingo",
        "files of collect",
        "files of extract",
        "versions",
    ):
        assert found[what]["verdict"] in ("good", "note"), found[what]


@pytest.mark.parametrize(
    ("file", "what"),
    [
        ("config.json", "files of config"),
        ("experience/part-00000.parquet", "files of collect"),
        ("world_model/model.safetensors", "files of train"),
        ("dbn/tables.npz", "files of extract"),
        ("results/episodes.parquet", "files of compare"),
        ("ialm/tables.npz", "files of compare"),
        ("summary.json", "summary.json"),
    ],
)
def test_a_damaged_file_is_named(file: str, what: str, run_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run_copy / file
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert main(["doctor", "--run", str(run_copy), "--json"]) == 2
    printed = capsys.readouterr()
    bad = [check for check in json.loads(printed.out)["checks"] if check["verdict"] == "bad"]
    assert what in [check["what"] for check in bad]
    assert all(check["advice"] for check in bad if check["what"] == what)
    assert len(printed.err.strip().splitlines()) == 1


def test_an_unfinished_run_can_be_gone_on_with(run_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_copy / "results" / "comparison.json").unlink()
    (run_copy / "report.html").unlink()
    assert main(["doctor", "--run", str(run_copy)]) == 0
    printed = capsys.readouterr().out
    assert "missing: compare, report" in printed
    assert f"nesy run --run {run_copy}" in printed


def test_no_run_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--run", str(tmp_path / "none")]) == 2
    assert "no such run folder" in capsys.readouterr().out
