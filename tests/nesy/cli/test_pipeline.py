"""The whole pipeline on a tiny run: what it leaves, what it repeats, what it refuses, what damage gives."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from domains import worlds
from domains.core import DomainSpec
from domains.person_following.domain import PersonFollowing
from nesy.cli import configuration, pipeline
from nesy.cli.configuration import PRESETS, RunConfig
from nesy.cli.main import main
from nesy.report.text import COMPARISON_COLUMNS, comparison_rows
from tests.conftest import TINY

INFLUENCES = ("random", "perspective-shift", "perfect-information")


@pytest.fixture(scope="module")
def run(tiny_run: Path) -> Path:
    return tiny_run


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "copy"))


def _error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of a mistake; progress lines come before it."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert sum(line.startswith("nesy: ") for line in lines) == 1
    assert "Traceback" not in "\n".join(lines)
    return lines[-1]


def test_the_run_folder_holds_what_the_contract_says(run: Path) -> None:
    for name in (
        "config.json",
        "experience/part-00000.parquet",
        "world_model/model.safetensors",
        "world_model/config.json",
        "world_model/metrics.jsonl",
        "dbn/model.json",
        "dbn/tables.npz",
        "ialm",
        "policies",
        "results/episodes.parquet",
        "summary.json",
        "report.html",
    ):
        assert (run / name).exists(), name
    assert not [path for path in run.rglob("*") if "tmp" in path.name]
    policies = list((run / "policies").glob("*.safetensors"))
    assert len(policies) == len(INFLUENCES)


def test_the_summary_has_every_section(run: Path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    gates = (
        "views_exact",
        "cells",
        "distinct_codes",
        "distinct_views",
        "next_code_nll",
        "next_view_exact",
        "next_view_cells",
    )
    for name in gates:
        assert name in summary["world_model"], name
    for name in ("max_difference_to_network", "nll", "rows", "max_parents"):
        assert name in summary["dbn"], name
    assert summary["dbn"]["max_difference_to_network"] <= 1e-6
    cells = {(cell["agent"], cell["influence"]) for cell in summary["comparison"]}
    for influence in INFLUENCES:
        assert ("dqn", influence) in cells
        assert ("pomdp", influence) in cells
    optimum = next(cell for cell in summary["comparison"] if cell["agent"] == "optimum")
    assert optimum["return"]["mean"] == pytest.approx(90.3, abs=0.5)
    assert optimum["success"]["mean"] == pytest.approx(0.807, abs=0.01)
    assert set(summary["timing"]) >= {"collect", "train", "extract", "semantics", "compare", "report"}
    assert {"versions", "seed", "machine"} <= set(summary["provenance"])


def test_means_of_the_table_are_those_of_the_episodes(run: Path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    rows = pq.read_table(run / "results" / "episodes.parquet").to_pylist()
    for cell in summary["comparison"]:
        returns = [
            row["return"]
            for row in rows
            if row["phase"] == "eval"
            and row["agent"] == cell["agent"]
            and (row["influence"] or "") == (cell["influence"] or "")
            and (row["inputs"] or "") == (cell["inputs"] or "")
        ]
        if returns:
            assert cell["return"]["mean"] == pytest.approx(sum(returns) / len(returns), abs=1e-3)
            assert cell["episodes"] == len(returns)


def test_the_page_is_self_contained_and_its_table_comes_from_the_summary(run: Path) -> None:
    page = (run / "report.html").read_text(encoding="utf-8")
    summary = json.loads((run / "summary.json").read_text())
    for row in comparison_rows(summary["comparison"]):
        assert all(f">{text}<" in page for text in row if text)
    for anchor in ("comparison", "learning", "belief", "world-model", "dbn", "provenance"):
        assert f'<section id="{anchor}">' in page
    assert page.count("<svg") >= 3
    # nothing is loaded: links lead within the page, pictures and scripts are in it
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    assert "Content-Security-Policy" in page


def test_running_again_repeats_nothing(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = (
        "config.json",
        "summary.json",
        "report.html",
        "results/comparison.csv",
        "results/replays.json",
        "experience/part-00000.parquet",
        "world_model/model.safetensors",
        "dbn/tables.npz",
        "results/episodes.parquet",
    )
    before = {name: (run / name).read_bytes() for name in kept}
    monkeypatch.setattr("nesy.cli.pipeline._versions", lambda: {"python": "of another day"})
    assert main(["run", "--run", str(run), *TINY]) == 0
    assert {name: (run / name).read_bytes() for name in kept} == before
    assert "optimum" in capsys.readouterr().out
    for command in ("collect", "train", "extract", "compare", "report"):
        assert main([command, "--run", str(run)]) == 0
        assert {name: (run / name).read_bytes() for name in kept} == before, command


def test_what_is_done_later_is_recorded_as_of_then(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = json.loads((copy / "summary.json").read_text())
    monkeypatch.setattr("nesy.cli.pipeline._versions", lambda: {"python": "of another day"})
    (copy / "report.html").unlink()
    assert main(["report", "--run", str(copy)]) == 0
    after = json.loads((copy / "summary.json").read_text())
    assert after["provenance"]["steps"].pop("report") == {"python": "of another day"}
    del before["provenance"]["steps"]["report"]
    assert after["provenance"]["steps"] == before["provenance"]["steps"]
    assert after["timing"].pop("report") > before["timing"].pop("report")
    assert after["timing"] == before["timing"] and after["comparison"] == before["comparison"]


def test_rows_of_the_table_are_about_the_same_episodes(run: Path) -> None:
    cells = json.loads((run / "summary.json").read_text())["comparison"]
    assert {cell["episodes"] for cell in cells} == {2, 42}
    assert {row[COMPARISON_COLUMNS.index("episodes")] for row in comparison_rows(cells)} == {"2"}
    rows = pq.read_table(run / "results" / "episodes.parquet").to_pylist()
    for cell in cells:
        played = [
            row["return"]
            for row in rows
            if row["phase"] == "eval"
            and row["episode"] < 2
            and row["agent"] == cell["agent"]
            and (row["influence"] or "") == cell["influence"]
        ]
        if cell["agent"] != "optimum":
            assert cell["shared"]["return"]["mean"] == pytest.approx(sum(played) / 2, abs=1e-3)
    assert "2 episodes of paper that all agents have played" in (run / "report.html").read_text()


def test_other_settings_for_a_finished_step_are_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "config.json").read_bytes()
    assert main(["train", "--run", str(run), "--epochs", "7"]) == 2
    assert "train.epochs: 2, now 7" in _error(capsys)
    assert (run / "config.json").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--agents", "dqm"], "unknown agent 'dqm'"),
        (["--variants", "bogus"], "unknown variant 'bogus'"),
        (["--seeds", "0", "0"], "seeds names something twice"),
        (["--dqn.episodes", "0"], "episodes must be at least 1"),
        (["--rules", "wrong.lp"], "wrong.lp:1:"),
    ],
)
def test_a_mistaken_comparison_leaves_the_run_as_it_was(
    options: list[str],
    expected: str,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wrong.lp").write_text("forbidden(forward :- now(wall_ahead).")
    before = (run / "config.json").read_bytes()
    assert main(["compare", "--run", str(run), *options]) == 2
    assert expected in _error(capsys)
    assert (run / "config.json").read_bytes() == before


def test_json_is_one_object_on_standard_output(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["extract", "--run", str(run), "--json"]) == 0
    assert "rows" in json.loads(capsys.readouterr().out)


def test_the_table_can_be_read(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["extract", "--run", str(run), "--factor", "0", "--action", "forward"]) == 0
    assert "forward" in capsys.readouterr().out
    assert main(["extract", "--run", str(run), "--factor", "8"]) == 2
    assert "the factors are 0 to 7" in _error(capsys)
    assert main(["extract", "--run", str(run), "--action", "jump"]) == 2
    assert "the actions are left" in _error(capsys)


@pytest.mark.parametrize(
    "question", [["--means", "0=0"], ["--changes", "forward"], ["--predicate", "wall_ahead"], ["--vocabulary"]]
)
def test_questions_are_answered(question: list[str], run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "--run", str(run), *question]) == 0
    assert capsys.readouterr().out.strip()
    assert main(["query", "--run", str(run), *question, "--json"]) == 0
    assert isinstance(json.loads(capsys.readouterr().out), dict)


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        (["--means", "8=0"], "factor"),
        (["--means", "0=8"], "value"),
        (["--means", "zero"], "FACTOR=VALUE"),
        (["--changes", "jump"], "jump"),
        (["--predicate", "wall_behind_me"], "wall_behind_me"),
        (["--program", "/nonexistent.lp"], "nonexistent.lp"),
    ],
)
def test_wrong_questions(question: list[str], expected: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "--run", str(run), *question]) == 2
    assert expected in _error(capsys)


DAMAGE = {
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "overwritten": lambda content: b"\x00garbage" + content[8:],
}


@pytest.mark.parametrize("damage", sorted(DAMAGE))
@pytest.mark.parametrize(
    ("file", "command", "removed"),
    [
        ("experience/part-00000.parquet", "train", "world_model"),
        ("world_model/model.safetensors", "extract", "dbn"),
        ("dbn/tables.npz", "compare", "results"),
        ("dbn/model.json", "query --means 0=0", None),
        ("results/statistics.json", "report", None),
        ("config.json", "train", None),
        ("summary.json", "report", None),
    ],
)
def test_a_damaged_file_gives_one_line(
    file: str, command: str, removed: str | None, damage: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if removed is not None:
        shutil.rmtree(copy / removed)
    path = copy / file
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    capsys.readouterr()
    assert main([*command.split(), "--run", str(copy)]) == 2
    assert path.name in _error(capsys)


def test_an_agent_s_choice_is_explained(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = tmp_path / "rules.lp"
    rules.write_text("forbidden(A) :- action(A), A != stay.\n")
    question = ["query", "--run", str(run), "--start", "0", "--person", "0,2,1", "--json"]
    for agent in ("dqn-full-perspective-shift", "pomdp-full-perspective-shift"):
        capsys.readouterr()
        assert main([*question, "--why", agent]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["agent"].startswith(agent) and found["values"][found["action"]] == max(found["values"].values())
        assert f"chooses '{found['action']}'" in found["text"] and found["support"]
        assert main([*question, "--why", agent, "--rules", str(rules)]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["action"] == "stay" and set(found["because"]) == {"left", "right", "forward"}


# ------------------------------------------------------------------ what a prepared run has fixed
class _Elsewhere(PersonFollowing):
    """The same task as a domain that declares nothing about how to learn."""

    spec = DomainSpec(name="elsewhere", variants=PersonFollowing.spec.variants)
    symmetries = property()  # type: ignore[assignment]


ELSEWHERE = _Elsewhere()


@pytest.fixture
def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder with nothing but a configuration, of another domain, variant and seed than those of the presets."""
    monkeypatch.setitem(worlds._REGISTRY, "elsewhere", f"{__name__}:ELSEWHERE")
    configuration.save(RunConfig(domain="elsewhere", variant="clean", seed=7), tmp_path / "config.json", {})
    return tmp_path


@pytest.mark.parametrize("preset", ["smoke", "quick", "paper"])
def test_a_preset_keeps_the_world_of_a_prepared_run(preset: str, prepared: Path) -> None:
    config = pipeline.base_config(["--run", str(prepared), "--preset", preset])
    assert (config.domain, config.variant, config.seed) == ("elsewhere", "clean", 7)
    assert config.compare.variants == ("clean",) and config.collect == PRESETS[preset].collect
    other = pipeline.base_config(["--run", str(prepared), f"--preset={preset}", "--variant", "intent"])
    assert (other.domain, other.variant, other.compare.variants) == ("elsewhere", "intent", ("intent",))
    new = pipeline.base_config(["--run", str(prepared / "new"), "--preset", preset])
    assert new == PRESETS[preset]


def test_a_run_goes_on_in_its_world_whatever_the_preset(prepared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ("--crossing-episodes", "2", "--following-episodes", "2")
    asked = ("train", "--run", str(prepared), "--preset", "smoke", "--mirror-images")
    before = (prepared / "config.json").read_bytes()
    assert main(list(asked)) == 2
    assert "elsewhere declares no symmetry" in _error(capsys)
    assert (prepared / "config.json").read_bytes() == before
    assert main(["collect", "--run", str(prepared), "--preset", "smoke", *few]) == 0
    config = json.loads((prepared / "config.json").read_text())
    assert (config["domain"], config["variant"], config["seed"]) == ("elsewhere", "clean", 7)
    assert (config["train"]["weighting"], config["train"]["mirror_images"]) == ("visits", False)
    capsys.readouterr()
    assert main(["collect", "--run", str(prepared), "--preset", "quick", *few, "--variant", "paper"]) == 2
    assert "variant: clean, now paper" in _error(capsys)


def test_a_run_of_person_following_says_what_its_steps_count_as(run: Path, copy: Path) -> None:
    train = json.loads((run / "config.json").read_text())["train"]
    assert (train["weighting"], train["mirror_images"]) == ("maps", True)
    # a run made before there was the setting goes on as it was made
    config = json.loads((copy / "config.json").read_text())
    del config["train"]["weighting"]
    (copy / "config.json").write_text(json.dumps(config))
    assert main(["train", "--run", str(copy), "--json"]) == 0
    assert json.loads((copy / "config.json").read_text())["train"]["weighting"] == "maps"
    assert main(["train", "--run", str(copy), "--weighting", "visits"]) == 2
