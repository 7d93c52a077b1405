"""Training as a product: same seed, same weights; resume is exact; damage is told in one line."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from domains.core import DomainError, DomainSpec, load_domain
from nesy.config import TrainConfig
from nesy.dbn.learning.extraction import extract
from nesy.errors import UserError
from nesy.log.experience import COLUMNS, Experience
from nesy.progress import SilentProgress, Task
from nesy.world_model import SymbolicCodec, load_world_model, save_world_model, train
from nesy.world_model.storage import load_tensors
from tests.nesy.conftest import SMALL, SYMMETRIES, toy_experience


class Killed(Exception):
    """Stands for the signal."""


class KilledAfter(SilentProgress):
    """Raises when the training reports its n-th epoch."""

    def __init__(self, epochs: int) -> None:
        self.left = epochs

    def task(self, description: str, total: int):  # type: ignore[no-untyped-def]
        outer = self

        class Bar:
            def __enter__(self) -> Task:
                return self

            def __exit__(self, *_: object) -> None:
                return None

            def advance(self, steps: int = 1, **metrics: float) -> None:
                if metrics:
                    outer.left -= 1
                    if outer.left == 0:
                        raise Killed

        return Bar()


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_tensors(folder / "model.safetensors")[0]


@pytest.mark.parametrize("architecture", ["symbolic", "paper"])
def test_resume_gives_the_same_weights_bit_for_bit(
    architecture: str, tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nesy.world_model.training.paper_training.STEPS", 8)
    config = SMALL if architecture == "symbolic" else TrainConfig(architecture="paper", epochs=3, batch_size=16)
    experience = toy_experience()
    whole = trained
    if architecture == "paper":
        whole = tmp_path / "whole"
        train(experience, config, whole, seed=1, symmetries=SYMMETRIES)
    folder = tmp_path / "cut"
    moments = (1, 2) if architecture == "paper" else (1, 2, 3, 1, 2)
    for epochs in moments:
        with pytest.raises(Killed):
            train(experience, config, folder, seed=1, progress=KilledAfter(epochs), symmetries=SYMMETRIES)
        assert not (folder / "model.safetensors").exists()
    train(experience, config, folder, seed=1, symmetries=SYMMETRIES)
    expected, got = weights(whole), weights(folder)
    assert expected.keys() == got.keys()
    for name, tensor in expected.items():
        assert torch.equal(tensor, got[name]), name
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["tick"] for line in lines] == list(range(1, len(lines) + 1))
    reference = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    for line, other in zip(lines, reference, strict=True):
        assert {**line, "seconds": 0} == {**other, "seconds": 0}


def test_killed_by_the_signal_and_resumed(tmp_path: Path, trained: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[2]); from pathlib import Path\n"
        "from tests.nesy.conftest import SMALL, SYMMETRIES, toy_experience\n"
        "from nesy.world_model import train\n"
        "train(toy_experience(), SMALL, Path(sys.argv[1]), seed=1, symmetries=SYMMETRIES)\n"
    )
    folder = tmp_path / "killed"
    root = str(Path(__file__).parents[3])
    process = subprocess.Popen([sys.executable, "-c", code, str(folder), root], cwd=root)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        log = folder / "metrics.jsonl"
        if log.exists() and len(log.read_text().splitlines()) >= 4:
            break
        time.sleep(0.01)
    process.kill()
    process.wait()
    train(toy_experience(), SMALL, folder, seed=1, symmetries=SYMMETRIES)
    expected, got = weights(trained), weights(folder)
    assert all(torch.equal(expected[name], got[name]) for name in expected)


def test_another_seed_or_setting_starts_anew(tmp_path: Path, toy, trained: Path) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "model"
    config = TrainConfig(epochs=2, batch_size=64, time_limit=0.0, held_out=0.0)
    first = train(toy, config, folder, seed=1)
    before = weights(folder)
    assert train(toy, config, folder, seed=1)["epochs"] == first["epochs"]
    train(toy, config, folder, seed=2)
    assert not all(torch.equal(before[name], weights(folder)[name]) for name in before if "0.weight" in name)


GATES = {
    "views_exact", "cells", "distinct_codes", "distinct_views", "values_used", "perplexity", "next_code_nll",
    "next_view_exact", "next_view_cells", "inverse_accuracy", "rollouts",
}  # fmt: skip


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_every_epoch_of_the_network_has_all_gates_on_held_out_maps(trained: Path) -> None:
    lines, metrics = lines_of(trained), json.loads((trained / "config.json").read_text())["metrics"]
    assert {line["stage"] for line in lines} == {"questions", "codes", "fit", "complete"}
    for line in lines:
        if line["stage"] in ("questions", "codes"):
            assert line["next_code_nll"] >= metrics["held_out"]["limits"]["next_code_nll"] - 1e-9
            continue
        assert set(line) >= GATES - ({"rollouts"} if line["stage"] == "complete" else set())
        views = metrics["held_out"] if line["stage"] == "fit" else metrics
        assert line["distinct_views"] == views["distinct_views"]
        assert 0 <= line["next_view_exact"] <= line["next_view_cells"] <= 1
    fits = [line for line in lines if line["stage"] == "fit"]
    assert fits[-1]["code_agreement"] == 1.0
    assert fits[-1]["next_code_nll"] == metrics["held_out"]["next_code_nll"]
    assert all(lines[-1]["passed"].values())


def test_where_views_are_many_gradients_alone_do_it(tmp_path: Path, toy, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr("nesy.world_model.training.symbolic_training.REFINE_UP_TO", 1)
    metrics = train(toy, SMALL, tmp_path, seed=1)
    lines = lines_of(tmp_path)
    assert [line["stage"] for line in lines] == ["network"] * SMALL.epochs + ["fit"] * SMALL.epochs
    for line in lines:
        assert set(line) >= GATES
        assert line["distinct_views"] == metrics["held_out"]["distinct_views"]
    assert lines[-1]["next_code_nll"] < lines[0]["next_code_nll"]
    assert metrics["held_out"]["next_code_nll"] >= metrics["held_out"]["limits"]["next_code_nll"] - 1e-9


def test_another_search_where_the_first_predicts_too_badly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nesy.world_model.training.symbolic_training.ENOUGH", -1.0)  # no book is good enough
    experience, whole, cut = toy_experience(), tmp_path / "whole", tmp_path / "cut"
    train(experience, SMALL, whole, seed=1)
    lines = lines_of(whole)
    searched = ["questions"] * 3 + ["codes"] * 4
    assert [line["stage"] for line in lines][:15] == [*searched, *searched, "fit"]
    _, value = load_tensors(whole / "checkpoint.safetensors")
    ends = [lines[6]["counted_nll"], lines[13]["counted_nll"]]
    assert value["trainer"]["search"]["book"]["nll"] == min(ends)
    for epochs in (7, 3, 4):  # after the first search, within the second, at its end
        with pytest.raises(Killed):
            train(experience, SMALL, cut, seed=1, progress=KilledAfter(epochs))
    train(experience, SMALL, cut, seed=1)
    expected, got = weights(whole), weights(cut)
    assert all(torch.equal(expected[name], got[name]) for name in expected)


def test_held_out_figures_are_of_maps_not_learned_from(trained: Path) -> None:
    metrics = json.loads((trained / "config.json").read_text())["metrics"]
    held_out = metrics["held_out"]
    assert 0 < held_out["distinct_views"] < metrics["distinct_views"]
    assert np.isfinite(held_out["next_code_nll"])
    assert held_out["next_code_nll"] >= held_out["limits"]["next_code_nll"] - 1e-9


def test_save_and_load_keep_everything(tmp_path: Path, trained: Path, toy) -> None:  # type: ignore[no-untyped-def]
    model = load_world_model(trained)
    save_world_model(model, tmp_path, {"note": 1})
    again = load_world_model(tmp_path)
    views = toy.view[:50]
    a, b = SymbolicCodec(model), SymbolicCodec(again)
    np.testing.assert_array_equal(a.codes(views), b.codes(views))
    beliefs, actions = a.beliefs(views), toy.action[:50]
    np.testing.assert_array_equal(a.predict(beliefs, actions), b.predict(beliefs, actions))
    np.testing.assert_array_equal(a.views(a.codes(views)), views)


def test_damage_is_told_in_one_line(tmp_path: Path, trained: Path) -> None:
    for name in ("config.json", "model.safetensors"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    weights_file, config_file = tmp_path / "model.safetensors", tmp_path / "config.json"
    whole, config = weights_file.read_bytes(), config_file.read_text()
    for damaged in (b"", whole[:100], whole[: len(whole) // 2], b"\xff" * 200):
        weights_file.write_bytes(damaged)
        with pytest.raises(UserError, match=r"model\.safetensors: damaged"):
            load_world_model(tmp_path)
    weights_file.unlink()
    with pytest.raises(UserError, match="no such file"):
        load_world_model(tmp_path)
    weights_file.write_bytes(whole)
    for text in ("{", "[]", config.replace('"hidden": 256', '"hidden": 128')):
        config_file.write_text(text)
        with pytest.raises(UserError):
            load_world_model(tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs"),
        ({"max_parents": 9}, "max_parents"),
        ({"searches": 0}, "searches"),
        ({"held_out": 1.0}, "held_out"),
        ({"device": "nowhere"}, "--device"),
        ({"architecture": "other"}, "unknown architecture"),
    ],
)
def test_impossible_settings(settings: dict[str, object], message: str, tmp_path: Path, toy) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(UserError, match=message):
        train(toy, TrainConfig(**settings), tmp_path)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="no experience"):
        train(toy.select(np.zeros(len(toy), bool)), SMALL, tmp_path)


# ------------------------------------------------------------------ what steps count as, actions, symmetries
def slippery(actions: int, steps: int = 6000) -> Experience:
    """Three views in a ring on one map: one on with 0.9, two on with 0.1; the last action stays."""
    rng = np.random.default_rng(0)
    views = np.zeros((3, 3, 3), np.uint8)
    views[1, 0, 0], views[2, 0, 0] = 1, 2
    before, action = rng.integers(0, 3, steps), rng.integers(0, actions, steps)
    then = np.where(action == actions - 1, before, (before + 1 + (rng.random(steps) < 0.1)) % 3)
    columns: dict[str, Any] = {name: np.zeros(steps, np.int64) for name in COLUMNS}
    poses = np.zeros((steps, 3), np.int16)
    columns |= {
        "episode": np.arange(steps), "source": np.full(steps, "crossing-random"), "action": action,
        "view": views[before], "next_view": views[then], "person_view": views[before],
        "next_person_view": views[then], "relative_pose": poses, "next_relative_pose": poses,
    }  # fmt: skip
    return Experience(**columns)


QUICK = TrainConfig(epochs=6, searches=1, held_out=0.0, time_limit=0.0)


@pytest.mark.parametrize("actions", [2, 6])
def test_chances_are_those_of_the_visits(actions: int, tmp_path: Path) -> None:
    """On one map a weight by maps makes 0.9 and 0.1 the same; and actions from 4 on once were those of other views."""
    experience = slippery(actions)
    train(experience, QUICK, tmp_path)
    views = np.unique(experience.view, axis=0)
    before, then = ((part[:, None] == views).all((2, 3)).argmax(1) for part in (experience.view, experience.next_view))
    counts = np.zeros((3, actions, 3))
    np.add.at(counts, (before, experience.action, then), 1)
    model = load_world_model(tmp_path)
    assert model.num_actions == actions
    codec = SymbolicCodec(model)
    dbn = extract(model, codec.codes(experience.view), experience.action, codec.codes(experience.next_view))
    codes = codec.codes(views)
    for a in range(actions):
        chances = np.exp(dbn.log_prob(codes[:, None], a, codes[None]))
        np.testing.assert_allclose(chances, counts[:, a] / counts[:, a].sum(1, keepdims=True), atol=0.02)


class _Domain:
    """Enough of a domain for a training: no map can be listed, no symmetry is declared."""

    predicates = load_domain().predicates
    spec = DomainSpec(name="elsewhere", variants=("only",), action_names=("north", "south", "east"))

    def transitions(self, *_: object, **__: object) -> None:
        raise DomainError("too many maps")


def test_a_training_knows_the_actions_of_its_domain(tmp_path: Path, toy) -> None:  # type: ignore[no-untyped-def]
    three = toy.select(toy.action < 2)  # the third action was never taken
    train(three, QUICK, tmp_path, domain=_Domain())  # type: ignore[arg-type]
    assert load_world_model(tmp_path).num_actions == 3
    with pytest.raises(UserError, match=r"actions are whole numbers in 0\.\.2, found 3"):
        train(toy, QUICK, tmp_path / "other", domain=_Domain())  # type: ignore[arg-type]


def test_mirror_images_only_where_a_symmetry_is_declared(tmp_path: Path, toy) -> None:  # type: ignore[no-untyped-def]
    asked = replace(QUICK, mirror_images=True)
    with pytest.raises(UserError, match="this experience declares no symmetry"):
        train(toy, asked, tmp_path)
    with pytest.raises(UserError, match="elsewhere declares no symmetry"):
        train(toy, asked, tmp_path, domain=_Domain())  # type: ignore[arg-type]
    assert not (tmp_path / "metrics.jsonl").exists()


@pytest.mark.parametrize(
    ("given", "weighting", "symmetric", "expected"),
    [
        ({}, "visits", False, ("visits", False)),
        ({}, "maps", True, ("maps", True)),
        ({"weighting": "visits", "mirror_images": False}, "maps", True, ("visits", False)),
        ({"weighting": "maps"}, "visits", False, ("maps", False)),
    ],
)
def test_what_is_not_set_is_as_the_world_declares(
    given: dict[str, Any], weighting: Any, symmetric: bool, expected: tuple[str, bool]
) -> None:
    config = TrainConfig(**given).in_world("w", weighting, symmetric)
    assert (config.weighting, config.mirror_images) == expected
    assert config.in_world("other", "visits", True) == config
    with pytest.raises(UserError, match="weighting must be visits or maps"):
        TrainConfig(weighting="steps")  # type: ignore[arg-type]
