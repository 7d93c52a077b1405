"""The command line: help, one clear line for every mistake, configurations."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from nesy.cli import configuration
from nesy.cli.main import COMMANDS, main
from nesy.cli.pipeline import base_config
from nesy.errors import UserError


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    for name in COMMANDS:
        assert f"  {name} " in printed


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["trian"], "did you mean 'train'"),
        (["train", "--epoch", "3"], "--epoch"),
        (["run", "--preset", "fast"], "fast"),
        (["train", "--seed", "x"], "--seed"),
        (["collect", "--jobs", "0"], "at least one process"),
        (["run", "--seed", "-1"], "seed must be at least 0"),
        (["run", "--variant", "bogus"], "unknown variant 'bogus' (known: paper, clean"),
        (["run", "--collect.num-envs", "0"], "nesy: collect: num_envs must be at least 1, not 0"),
        (["run", "--compare.dqn.hidden", "64", "0"], "hidden must be at least 1"),
        (["run", "--compare.search.discount", "1"], "discount must be in [0, 1)"),
        (["run", "--compare.rules", "gone.lp"], "gone.lp: no such file"),
        (["query"], "ask one question"),
        (["query", "--means", "3=5", "--changes", "left"], "ask one question"),
    ],
)
def test_wrong_command_line(
    arguments: list[str],
    expected: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert expected in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_run_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.touch()
    assert main(["run", "--run", str(path)]) == 2
    assert "is a file; a run is a folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "extract", "compare", "report", "query --vocabulary"])
def test_missing_run_folder(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main([*command.split(), "--run", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert "no such run folder" in error
    assert len(error.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        ("train", "collect"),
        ("extract", "collect"),
        ("compare", "collect"),
        ("report", "collect"),
        ("query --vocabulary", "extract"),
    ],
)
def test_run_folder_that_lacks_a_step(
    command: str, missing: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    configuration.save(configuration.PRESETS["smoke"], tmp_path / "config.json", {})
    assert main([*command.split(), "--run", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert f"lacks the step '{missing}'" in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.parametrize("preset", sorted(configuration.PRESETS))
def test_configuration_round_trip(preset: str, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    configuration.save(configuration.PRESETS[preset], path, {"python": "3"})
    assert configuration.load(path) == configuration.PRESETS[preset]


def test_retired_settings_are_read_where_they_mean_what_happens_now(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    configuration.save(configuration.PRESETS["smoke"], path, {})
    document = json.loads(path.read_text())
    document["compare"]["search"]["mind_discount"] = 0.99
    path.write_text(json.dumps(document))
    assert configuration.load(path) == configuration.PRESETS["smoke"]
    document["compare"]["search"]["mind_discount"] = 0.5
    path.write_text(json.dumps(document))
    with pytest.raises(UserError, match="unknown setting 'mind_discount'"):
        configuration.load(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"format": 99}, "format"),
        ({"sed": 1}, "unknown setting 'sed'"),
        ({"seed": "one"}, "seed: expected int"),
        ({"seed": True}, "seed: expected int"),
        ({"preset": "huge"}, "is not one of"),
        ({"train": {"epochs": 1.5}}, "epochs: expected int"),
        ({"train": []}, "expected an object"),
        ({"compare": {"agents": "dqn"}}, "expected a list"),
        ({"compare": {"agents": ["dqm"]}}, r"config\.json: unknown agent 'dqm'"),
        ({"compare": {"confidence": 1.0}}, "confidence must be in"),
    ],
)
def test_damaged_configuration(change: dict[str, object], expected: str, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    configuration.save(configuration.PRESETS["smoke"], path, {})
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(UserError, match=expected):
        configuration.load(path)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[1]", b"[" * 100_000])
def test_configuration_that_is_not_json(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"config\.json"):
        configuration.load(path)


def test_a_run_on_another_variant_compares_on_it(tmp_path: Path) -> None:
    arguments = ["--run", str(tmp_path), "--variant", "intent"]
    config = base_config(arguments)
    assert (config.variant, config.compare.variants) == ("intent", ("intent",))
    assert base_config(arguments[:2]).compare.variants == ("paper",)
    configuration.save(config, tmp_path / "config.json", {})
    assert base_config(arguments[:2]) == config


def test_numbers_may_be_written_as_integers(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    configuration.save(configuration.PRESETS["smoke"], path, {})
    settings = json.loads(path.read_text())
    settings["train"]["kl_weight"] = 1
    path.write_text(json.dumps(settings))
    assert configuration.load(path).train.kl_weight == 1.0


@pytest.mark.parametrize("agent", ["random", "goal", "follower", "optimum"])
def test_play_records_an_episode(agent: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from PIL import Image

    film = tmp_path / "episode.gif"
    assert main(["play", "--agent", agent, "--seed", "3", "--record", str(film), "--json"]) == 0
    episode = json.loads(capsys.readouterr().out)["episodes"][0]
    with Image.open(film) as pictures:
        assert pictures.n_frames <= episode["length"] + 1  # equal frames in a row are stored once
        assert pictures.n_frames > 1


def test_play_tells_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments, expected in (
        (["--agent", "random", "--record", str(tmp_path / "x.avi")], ".gif or .mp4"),
        (["--agent", "random", "--size", "8"], "odd"),
        (["--agent", "random", "--variant", "none"], "unknown variant"),
        (["--agent", "random", "--episodes", "0"], "at least one"),
        ([], "needs a terminal"),
    ):
        assert main(["play", *arguments]) == 2
        assert expected in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_person_drives_with_the_keyboard(tmp_path: Path) -> None:
    """In a real terminal: keys move the robot, r begins again, q quits, and the terminal is as it was before."""
    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    command = [sys.executable, "-m", "nesy.cli.main", "play", "--variant", "paper", "--json"]
    with subprocess.Popen(command, stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as game:
        assert game.stderr is not None
        drawn = b""
        while b"step 0" not in drawn and (more := os.read(game.stderr.fileno(), 4096)):
            drawn += more
        os.write(master, b"w\x1b[Crw\x1b[D\x1b[Aq")
        shown, more = game.communicate(timeout=60)
        drawn += more
    assert game.returncode == 0, drawn.decode()
    assert json.loads(shown) == {"episodes": []}
    steps = re.findall(r"step (\d+)  return", drawn.decode())
    assert steps == ["0", "1", "2", "0", "1", "2", "3"]
    assert termios.tcgetattr(slave) == before
    os.close(master)
    os.close(slave)
