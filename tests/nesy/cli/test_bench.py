"""`nesy bench`: the registry of suites, what is stored, and what it says when something is wrong."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

from nesy.cli.benches import SUITES
from nesy.cli.benches.measuring import Row, Settings, ranked, rate
from nesy.cli.commands import bench
from nesy.cli.main import main
from nesy.run_folder import STEPS


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_says_what_it_measures_and_needs(name: str) -> None:
    suite = importlib.import_module(f"nesy.cli.benches.{name}")
    assert suite.__doc__.splitlines()[0].endswith(".")
    assert set(suite.NEEDS) <= set(STEPS)
    assert callable(suite.measure)


def test_figures_are_stored_beside_those_of_other_suites(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bench.json"
    out.write_text(json.dumps({"suites": {"other": [1]}}))

    def measure(settings: Settings) -> list[Row]:
        assert (settings.seconds, settings.seed) == (0.5, 7)
        return ranked("things/s", "slow", {"fast": 200.0, "slow": 100.0})

    monkeypatch.setattr("nesy.cli.benches.env.measure", measure)
    assert main(["bench", "env", "--seconds", "0.5", "--seed", "7", "--out", str(out), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["suites"]["env"]
    assert rows[0] == {"what": "fast", "figure": 200.0, "unit": "things/s", "peer": "slow", "ratio": 2.0}
    assert json.loads(out.read_text())["suites"] == {"other": [1], "env": rows}


def test_what_cannot_be_measured_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in ((["none"], "no suite 'none'"), (["env", "--seconds", "0"], "--seconds 0")):
        assert main(["bench", *arguments, "--out", str(tmp_path / "b.json")]) == 2
        assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_all_leaves_out_what_the_run_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "SUITES", ("env",))
    monkeypatch.setattr("nesy.cli.benches.env.NEEDS", ("train",))
    arguments = ["--run", str(tmp_path / "none"), "--out", str(tmp_path / "b.json")]
    assert main(["bench", "all", *arguments]) == 0
    assert "env: not measured" in capsys.readouterr().err
    assert main(["bench", "env", *arguments]) == 2
    assert "no such run folder" in capsys.readouterr().err


def test_rate_counts_what_is_done_after_the_warm_up() -> None:
    now = [0.0]
    calls = []

    def work() -> int:
        now[0] += 1.0
        calls.append(now[0])
        return 10

    assert rate(work, 3.0, warm_up=2, clock=lambda: now[0]) == 10.0
    assert len(calls) == 5
