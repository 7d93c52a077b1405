"""Steps as numbers of distinct views: the same transitions as from experience in memory, nothing left on the disk."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nesy.errors import UserError
from nesy.log.experience import COLUMNS, Experience, write_part
from nesy.world_model import columns as module
from nesy.world_model.columns import Columns
from nesy.world_model.distinct import Transitions, transitions_of


@pytest.fixture
def folder(tmp_path: Path, toy: Experience) -> Path:
    """The toy world's experience in two parts."""
    for number, rows in enumerate((slice(0, 700), slice(700, None))):
        part = {name: getattr(toy, name)[rows] for name in COLUMNS}
        write_part(tmp_path / "experience" / f"part-{number:05d}.parquet", part)
    return tmp_path / "experience"


def assert_same(found: Transitions, expected: Transitions) -> None:
    for name in ("views", "visits", "source", "action", "target", "weight"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_mapped_columns_hold_every_step_and_leave_no_file(folder: Path, toy: Experience, tmp_path: Path) -> None:
    columns = Columns.mapped(folder, tmp_path / "scratch")
    assert not list((tmp_path / "scratch").iterdir())
    assert isinstance(columns.source, np.memmap)
    np.testing.assert_array_equal(columns.views[columns.source], toy.view)
    np.testing.assert_array_equal(columns.views[columns.target], toy.next_view)
    np.testing.assert_array_equal(columns.maps[columns.place], toy.map_id)
    np.testing.assert_array_equal(columns.action, toy.action)


def test_transitions_are_those_of_experience_in_memory(
    folder: Path, toy: Experience, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CHUNK", 333)
    columns = Columns.mapped(folder, tmp_path / "scratch")
    further = np.full((1, 5, 5), 2, dtype=np.uint8)
    assert_same(columns.transitions(), transitions_of(toy))
    assert_same(columns.transitions(views=further), transitions_of(toy, views=further))
    apart = columns.held_out(0.25, np.random.default_rng(5))
    rows = toy.held_out_maps(0.25, np.random.default_rng(5))
    np.testing.assert_array_equal(columns.maps[apart], np.unique(toy.map_id[rows]))
    assert_same(columns.transitions(~apart, further), transitions_of(toy.select(~rows), views=further))
    np.testing.assert_array_equal(columns.rows(apart), np.flatnonzero(rows))


def test_views_of_many_cells_and_blocked_steps(toy: Experience) -> None:
    import dataclasses

    wide = np.zeros((len(toy), 7, 7), dtype=np.uint8)
    wide[:, 1:6, 2:] = toy.view
    after = np.zeros_like(wide)
    after[:, 1:6, 2:] = toy.next_view
    ahead = np.zeros(len(toy), dtype=np.int16)
    ahead[::3] = 1 + (3 * 7 + 5) * 4
    experience = dataclasses.replace(toy, view=wide, next_view=after, configuration=ahead)
    columns = Columns.of(experience)
    assert_same(columns.transitions(), transitions_of(experience))
    assert (np.flatnonzero(~columns.free) == np.arange(0, len(toy), 3)).all()


def test_no_experience_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no experience"):
        Columns.mapped(tmp_path, tmp_path / "scratch")


def test_room_on_the_disk_is_reserved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing through the map into a hole of a full disk ended the process with a bus error."""
    opened = []
    real = np.memmap

    def memmap(stream: Any, **options: Any) -> Any:
        opened.append(os.fstat(stream.fileno()))
        return real(stream, **options)

    monkeypatch.setattr(np, "memmap", memmap)
    array = module._nameless(tmp_path, 100_000, np.int64)
    assert array.shape == (100_000,)
    assert opened[0].st_blocks * 512 >= array.nbytes == opened[0].st_size


# ------------------------------------------------------------------ what is refused, and what is not taken for other
def test_more_actions_than_four_are_told_apart(toy: Experience, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against plain counting: an action was once taken modulo 4 and its view for another."""
    import dataclasses

    monkeypatch.setattr(module, "CHUNK", 333)
    rng = np.random.default_rng(0)
    action = rng.integers(0, 7, len(toy))
    experience = dataclasses.replace(toy, action=action)
    expected: dict[tuple[bytes, int, bytes], int] = {}
    maps: dict[tuple[bytes, int, bytes], set[int]] = {}
    for view, a, then, place in zip(toy.view, action, toy.next_view, toy.map_id, strict=True):
        key = (view.tobytes(), int(a), then.tobytes())
        expected[key] = expected.get(key, 0) + 1
        maps.setdefault(key, set()).add(int(place))
    for weighting in ("visits", "maps"):
        for t in (
            Columns.of(experience).transitions(weighting=weighting),
            transitions_of(experience, weighting=weighting),
            Columns.of(experience, 9).transitions(weighting=weighting),
        ):
            assert t.num_actions in (7, 9)
            found = {
                (t.views[s].tobytes(), int(a), t.views[then].tobytes()): int(w)
                for s, a, then, w in zip(t.source, t.action, t.target, t.weight, strict=True)
            }
            assert found == (expected if weighting == "visits" else {key: len(met) for key, met in maps.items()})


@pytest.mark.parametrize(
    ("changes", "num_actions", "message"),
    [
        ({"action": lambda a: a + 1}, 4, r"actions are whole numbers in 0\.\.3, found 4"),
        ({"action": lambda a: a - 1}, None, "actions .* found -1"),
        ({"action": lambda a: a + 100}, None, r"actions are whole numbers in 0\.\.63"),
        ({"action": lambda a: a / 2}, None, r"actions .* found .\.5"),
        ({"action": lambda a: a[:5]}, None, "differ in length"),
        ({"view": lambda v: v + 3}, None, r"cells of views .* in 0\.\.3, found 4"),
        ({"next_view": lambda v: v.astype(int) - 1}, None, "cells of views .* found -1"),
        ({"next_view": lambda v: v.astype(int) + 256}, None, "cells of views"),
        ({"view": lambda v: v[:, :4], "next_view": lambda v: v[:, :4]}, None, "views must be square"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(
    toy: Experience, changes: dict[str, Any], num_actions: int | None, message: str
) -> None:
    import dataclasses

    changed = {name: change(getattr(toy, name)) for name, change in changes.items()}
    with pytest.raises(UserError, match=message):
        Columns.of(dataclasses.replace(toy, **changed), num_actions)


def test_episodes_are_told_apart_whatever_their_numbers(toy: Experience) -> None:
    import dataclasses

    episode = np.arange(len(toy)) * (1 << 32)
    assert len(np.unique(Columns.of(dataclasses.replace(toy, episode=episode)).episode)) == len(toy)


@pytest.mark.parametrize("size", [3, 5, 7])
def test_equal_keys_are_equal_views(size: int) -> None:
    from nesy.world_model.distinct import view_keys

    views = np.random.default_rng(size).integers(0, 4, (200, size, size))
    views[100:] = views[:100]
    views[150:, 0, 0] = (views[150:, 0, 0] + 1) % 4
    keys = view_keys(views)
    same = (views[:, None] == views[None]).all((2, 3))
    np.testing.assert_array_equal(keys[:, None] == keys[None], same)
    for wrong in (views + 1, views - 1, views[:, :-1], views / 2, views[0]):
        with pytest.raises(UserError):
            view_keys(wrong)
