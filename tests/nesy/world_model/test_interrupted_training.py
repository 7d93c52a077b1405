"""The script that kills trainings: two kills on the toy world, and a difference is noticed."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from nesy.log.experience import COLUMNS, Experience, write_part
from nesy.world_model import train
from tests.nesy.conftest import SMALL


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).parents[3] / "scripts" / "interrupted_training.py"
    spec = importlib.util.spec_from_file_location("interrupted_training", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look there
    spec.loader.exec_module(module)
    return module


def test_two_kills_change_nothing(script: ModuleType, toy: Experience, tmp_path: Path) -> None:
    experience = tmp_path / "experience"
    write_part(experience / "part-00000.parquet", {name: getattr(toy, name) for name in COLUMNS})
    trainings, moments = script.interrupted(experience, SMALL, tmp_path, kills=2, seed=1)
    assert trainings >= 1
    assert len(moments) == 2
    train(toy, SMALL, tmp_path / "in memory", seed=1)
    script.compare(tmp_path / "whole", tmp_path / "in memory")


def test_a_difference_is_noticed(script: ModuleType, trained: Path, tmp_path: Path) -> None:
    for name in ("model.safetensors", "metrics.jsonl"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    script.compare(trained, tmp_path)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(AssertionError, match="figures"):
        script.compare(trained, tmp_path)
