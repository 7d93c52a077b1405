"""Atomic writes, locks and steps of a run folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from nesy.errors import UserError
from nesy.run_folder import RunFolder, atomic_path, read_json, write_json


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    write_json(path, {"a": 1})
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert read_json(path) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_values_that_json_does_not_know_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": 1}


def test_only_one_writer(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    with run.lock(), pytest.raises(UserError, match="is being written by"), run.lock():
        pass
    with run.lock():
        pass


def test_sections_of_the_summary_are_replaced_whole(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.update_summary(first={"a": 1}, second=2)
    run.update_summary(first={"b": 3})
    assert run.read_summary() == {"first": {"b": 3}, "second": 2}


@pytest.mark.parametrize("content", ["", "{", "[1, 2]"])
def test_a_damaged_summary_is_named(content: str, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.summary.write_text(content)
    with pytest.raises(UserError, match=r"summary\.json"):
        run.read_summary()


def test_open_tells_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such run folder"):
        RunFolder.open(tmp_path / "none")
    with pytest.raises(UserError, match="not a run folder"):
        RunFolder.open(tmp_path)


def test_require_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nesy train --run"):
        RunFolder(tmp_path).require("train")


@pytest.mark.parametrize("text", ["1" + "0" * 5000, str(2**63), "[NaN]", "-Infinity", '{"a": ' * 100_000])
def test_json_beyond_what_we_write_is_one_clear_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "it.json"
    path.write_text(text)
    with pytest.raises(UserError, match="not valid JSON") as caught:
        read_json(path)
    assert len(str(caught.value)) < 1000
