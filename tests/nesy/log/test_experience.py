from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from nesy.errors import UserError
from nesy.log.experience import COLUMNS, SOURCES, Experience, count_rows, load_columns, write_part


def columns(rows: int, rng: np.random.Generator, source: str = "crossing-random") -> dict[str, np.ndarray]:
    views = rng.integers(0, 4, (4, rows, 5, 5)).astype(np.uint8)
    poses = rng.integers(-3, 4, (2, rows, 3)).astype(np.int16)
    scalars = {name: rng.integers(0, 5, rows) for name in COLUMNS}
    return scalars | {
        "source": np.array([source] * rows),
        "view": views[0],
        "next_view": views[1],
        "person_view": views[2],
        "next_person_view": views[3],
        "relative_pose": poses[0],
        "next_relative_pose": poses[1],
        "reward": rng.normal(size=rows),
        "terminated": rng.random(rows) < 0.5,
        "truncated": rng.random(rows) < 0.5,
        "visible": rng.random(rows) < 0.5,
        "distance": rng.random(rows),
    }


def test_round_trip_keeps_values_order_and_types(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first, second = columns(7, rng), columns(5, rng, "following-mixture")
    assert write_part(tmp_path / "part-00000.parquet", first) == 7
    write_part(tmp_path / "part-00001.parquet", second)
    experience = Experience.load(tmp_path)
    assert len(experience) == 12
    for name in COLUMNS:
        expected = np.concatenate([first[name], second[name]])
        got = getattr(experience, name)
        assert got.shape == expected.shape, name
        if name in ("reward", "distance"):
            assert got.dtype == np.float32
            np.testing.assert_allclose(got, expected, rtol=1e-6)
        else:
            np.testing.assert_array_equal(got, expected)
    assert experience.view.dtype == np.uint8
    assert experience.configuration.dtype == np.int16
    assert len(Experience.load(tmp_path, sources=["following-mixture"])) == 5


def test_split_by_map_shares_no_map(tmp_path: Path) -> None:
    data = columns(200, np.random.default_rng(1))
    data["map_id"] = np.random.default_rng(2).integers(0, 10, 200)
    write_part(tmp_path / "part-00000.parquet", data)
    experience = Experience.load(tmp_path)
    train, held_out = experience.split_by_map(0.2, np.random.default_rng(3))
    assert len(np.unique(held_out.map_id)) == 2
    assert not set(train.map_id) & set(held_out.map_id)
    assert len(train) + len(held_out) == 200
    everything, nothing = experience.split_by_map(0.0, np.random.default_rng(3))
    assert (len(everything), len(nothing)) == (200, 0)
    with pytest.raises(UserError, match="held-out share"):
        experience.split_by_map(1.0, np.random.default_rng(3))


def test_damage_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no experience here"):
        Experience.load(tmp_path)
    part = tmp_path / "part-00000.parquet"
    write_part(part, columns(50, np.random.default_rng(0)))
    assert count_rows(part) == 50
    with pytest.raises(UserError, match="unknown experience source"):
        Experience.load(tmp_path, sources=["nowhere"])
    with pytest.raises(UserError, match="no transitions of the sources"):
        Experience.load(tmp_path, sources=["following-random"])
    whole = part.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"PAR1" + bytes(60) + b"PAR1"):
        part.write_bytes(damaged)
        assert count_rows(part) is None
        with pytest.raises(UserError, match=r"part-00000\.parquet: damaged"):
            Experience.load(tmp_path)
    pq.write_table(pa.table({"action": [1, 2]}), part)
    with pytest.raises(UserError, match="columns missing"):
        Experience.load(tmp_path)
    table = {name: pa.array([0]) for name in COLUMNS}
    pq.write_table(pa.table(table), part)
    with pytest.raises(UserError, match="other types"):
        Experience.load(tmp_path)


def test_flipped_bytes_never_pass_unnoticed_as_a_crash(tmp_path: Path) -> None:
    """Whatever a damaged part holds, loading it gives data or a UserError, never another exception."""
    part = tmp_path / "part-00000.parquet"
    write_part(part, columns(50, np.random.default_rng(0)))
    whole = bytearray(part.read_bytes())
    rng = np.random.default_rng(5)
    for _ in range(60):
        damaged = bytearray(whole)
        for position in rng.integers(0, len(whole), 8):
            damaged[position] = rng.integers(256)
        part.write_bytes(bytes(damaged))
        try:
            Experience.load(tmp_path)
        except UserError as error:
            assert "part-00000.parquet" in str(error)


def test_some_columns_alone_are_those_of_all(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_part(tmp_path / "part-00000.parquet", columns(7, rng))
    write_part(tmp_path / "part-00001.parquet", columns(5, rng, "following-mixture"))
    everything = Experience.load(tmp_path)
    some = load_columns(tmp_path, ("view", "action", "source_number"))
    assert list(some) == ["view", "action", "source_number"]
    np.testing.assert_array_equal(some["view"], everything.view)
    np.testing.assert_array_equal(np.array(SOURCES)[some["source_number"]], everything.source)
    assert len(load_columns(tmp_path, ("action",), ("following-mixture",))["action"]) == 5


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("view", lambda v: v + 4, r"column view holds \d, which is none of 0\.\.3"),
        ("next_view", lambda v: v.astype(int) - 1, "column next_view holds -1"),
        ("person_view", lambda v: v + 0.5, "column person_view holds"),
        ("next_person_view", lambda v: v.astype(int) + 256, "column next_person_view holds"),
        ("view", lambda v: v[:, :, :4], "views must be square"),
        ("view", lambda v: v.reshape(len(v), 25), "views must be square"),
        ("next_view", lambda v: v[:, :3, :3], "next_view must have the shape"),
        ("action", lambda a: a + 64, r"column action holds \d+, which is none of 0\.\.63"),
        ("action", lambda a: a + 256, "column action holds"),
        ("action", lambda a: a - 10, "column action holds -"),
        ("action", lambda a: np.array(["go"] * len(a)), "column action holds str"),
        ("action", lambda a: a[:3], "must have the shape"),
        ("outcome", lambda a: a + 100, "column outcome holds"),
        ("configuration", lambda a: a + 70_000, "column configuration holds"),
        ("t", lambda a: a + (1 << 40), "column t holds"),
        ("reward", lambda r: r * np.nan, "column reward holds nan"),
        ("terminated", lambda b: b + 2, "column terminated holds"),
        ("source", lambda s: np.array(["elsewhere"] * len(s)), "unknown source 'elsewhere'"),
        ("relative_pose", lambda p: p[:, :2], "relative_pose must have the shape"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(name: str, change: Any, message: str, tmp_path: Path) -> None:
    data = columns(7, np.random.default_rng(0))
    data["action"] = np.arange(7)
    path = tmp_path / "part-00000.parquet"
    with pytest.raises(UserError, match=message):
        write_part(path, {**data, name: change(data[name])})
    with pytest.raises(UserError, match="columns missing or unknown"):
        write_part(path, {**data, "extra": data["t"]})
    assert not path.exists()
    assert write_part(path, data) == 7 and len(Experience.load(tmp_path)) == 7
