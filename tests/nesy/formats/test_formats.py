"""Files written and read back."""

import csv

import clingo
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nesy import formats
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.steps import with_steps
from tests.nesy.dbn.test_storage import same
from tests.nesy.dbn.toy import toy


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("name", ["native", "parquet", "jgum"])
def test_round_trips_are_bit_equal(tmp_path, name, seed):
    rng = np.random.default_rng(seed)
    dbn = with_steps(random_dbn(rng), rng, next_parents=seed % 2 == 1)
    path = tmp_path / f"{seed}{formats.FORMATS[name].suffix}"
    formats.export(dbn, path)
    assert same(formats.read(path), dbn)


def test_parquet_keeps_everything_else_too(tmp_path):
    dbn = toy()[0]
    formats.export(dbn, tmp_path / "m.parquet")
    assert same(formats.read(tmp_path / "m.parquet"), dbn)
    table = pq.read_table(tmp_path / "m.parquet")
    row = table.slice(9 + 9 + 3, 1).to_pylist()[0]
    assert table.num_rows == dbn.probabilities.size
    assert row["action"] == "swap" and row["factor"] == "goal" and row["parents"] == ["goal"]
    assert (row["parent_values"], row["value"], row["probability"], row["count"]) == ([1], 0, 0.0, 4)


def test_csv_holds_every_probability_exactly(tmp_path):
    dbn = random_dbn(np.random.default_rng(1))
    formats.export(dbn, tmp_path / "m.csv")
    with (tmp_path / "m.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_array_equal([float(row["probability"]) for row in rows], dbn.probabilities.reshape(-1))
    a, i = 1, 2
    start = int(dbn.offsets[a, i]) * 3
    names = [dbn.factor_names[p] + ("'" if where else "") for where, p in dbn.parents(a, i)]
    assert rows[start]["parents"] == " ".join(f"{name}=0" for name in names)
    assert (rows[start]["action"], rows[start]["factor"]) == ("a1", "X2")


def test_asp_facts_are_a_program_that_clingo_takes(tmp_path):
    dbn = toy()[0]
    formats.export(dbn, tmp_path / "m.lp")
    control = clingo.Control()
    control.load(str(tmp_path / "m.lp"))
    control.ground([("base", [])])
    rows = sum(1 for _ in control.symbolic_atoms.by_signature("row", 5))
    assert rows == int((dbn.probabilities > 0).sum())


def test_wrong_formats_and_places_are_explained(tmp_path):
    dbn = toy()[0]
    with pytest.raises(UserError, match="no format"):
        formats.export(dbn, tmp_path / "m.doc")
    with pytest.raises(UserError, match="no format 'word'"):
        formats.export(dbn, tmp_path / "m", format="word")
    with pytest.raises(UserError, match="is a folder"):
        formats.export(dbn, tmp_path, format="csv")
    with pytest.raises(UserError, match="no such file"):
        formats.read(tmp_path / "none.parquet")
    formats.export(dbn, tmp_path / "m.csv")
    with pytest.raises(UserError, match="cannot be read back"):
        formats.read(tmp_path / "m.csv")


@pytest.mark.parametrize(("name", "every"), [("parquet", 23), ("jgum", 29), ("native", 41)])
def test_any_damaged_byte_is_found_or_changes_nothing(tmp_path, name, every):
    """In Parquet files there are bytes that say nothing (statistics, columns that only people read)."""
    dbn = with_steps(toy()[0], np.random.default_rng(0))
    path = tmp_path / f"m{formats.FORMATS[name].suffix}"
    formats.export(dbn, path, format=name)
    harmless = 0
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        content = file.read_bytes()
        for position in range(0, len(content), every):
            damaged = bytearray(content)
            damaged[position] ^= 1 << position % 8
            file.write_bytes(damaged)
            try:
                assert same(formats.read(path, format=name), dbn), position
                harmless += 1
            except UserError as error:
                assert "\n" not in str(error) and str(path) in str(error)
        file.write_bytes(content)
    assert name == "parquet" or not harmless


@pytest.mark.parametrize("name", ["parquet", "jgum"])
def test_truncated_and_swapped_files_give_one_line(tmp_path, name):
    path = tmp_path / f"m.{name}"
    formats.export(toy()[0], path)
    content = path.read_bytes()
    other = tmp_path / ("o.jgum" if name == "parquet" else "o.parquet")
    formats.export(toy()[0], other)
    for damaged in (b"", content[: len(content) // 3], content[:-1], content + b" ", other.read_bytes(), b"\x00" * 999):
        path.write_bytes(damaged)
        with pytest.raises(UserError) as caught:
            formats.read(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_parquet_of_something_else_and_in_another_order_is_refused(tmp_path):
    path = tmp_path / "m.parquet"
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(UserError):
        formats.read(path)
    formats.export(toy()[0], path)
    table = pq.read_table(path)
    pq.write_table(table.take(list(range(table.num_rows))[::-1]), path)
    with pytest.raises(UserError, match=r"order|checksum"):
        formats.read(path)


def test_graphs_have_every_arc(tmp_path):
    import networkx

    dbn = random_dbn(np.random.default_rng(2))
    formats.export(dbn, tmp_path / "m.graphml")
    graph = networkx.read_graphml(tmp_path / "m.graphml")
    arcs = sum(len(dbn.parents(a, i)) for a in range(2) for i in range(3))
    assert graph.number_of_nodes() == 6 and graph.number_of_edges() == arcs
    formats.export(dbn, tmp_path / "m.dot")
    text = (tmp_path / "m.dot").read_text()
    assert text.count(" -> ") == arcs and text.count("subgraph") == 2


@pytest.mark.parametrize("name", ["jgum", "native"])
def test_jgum_and_native_keep_every_bit_without_pyagrum(tmp_path, name):
    dbn = toy()[0]
    path = tmp_path / f"m{formats.FORMATS[name].suffix}"
    formats.export(dbn, path)
    assert same(formats.read(path), dbn)


def sealed(content):
    """A hostile file: content changed, checksum right."""
    import hashlib
    import json

    properties = content.pop("properties", None)
    if properties is None:
        return json.dumps(content)
    properties.pop("sha256")
    body = json.dumps({**content, "properties": properties})[:-2] + ', "sha256": "'
    return body + hashlib.sha256(body.encode()).hexdigest() + '"}}\n'


def test_hostile_jgum_gives_one_line(tmp_path):
    import json

    path = tmp_path / "m.jgum"
    formats.export(toy()[0], path)
    content = json.loads(path.read_text())
    path.write_text(sealed(json.loads(json.dumps(content))))
    assert same(formats.read(path), toy()[0])
    for change in (
        lambda c: c.pop("properties"),
        lambda c: c["cpt"].pop("front"),
        lambda c: c["cpt"].update(front__swap=[1.0]),
        lambda c: c["cpt"].update(front__swap=["a"] * 9),
        lambda c: c["cpt"].update(front__swap=[0.9] * 9),
        lambda c: c["parents"].update(front__swap=["goal"]),
        lambda c: c["properties"].update({"nesy-2dbn": "{}"}),
        lambda c: c["properties"].update({"nesy-2dbn": "["}),
    ):
        damaged = json.loads(json.dumps(content))
        change(damaged)
        path.write_text(sealed(damaged))
        with pytest.raises(UserError) as caught:
            formats.read(path)
        assert "\n" not in str(caught.value) and "checksum" not in str(caught.value)
    path.write_text("{")
    with pytest.raises(UserError, match="JSON"):
        formats.read(path)


def test_a_large_model_goes_through_the_formats_that_are_read_back(tmp_path):
    rng = np.random.default_rng(0)
    parents = [[sorted(rng.choice(20, 3, replace=False).tolist()) for _ in range(20)]]
    dbn = TwoSliceDBN.from_tables([[rng.dirichlet(np.ones(16), size=16**3) for _ in range(20)]], parents)
    for name in ("native", "parquet", "jgum"):
        path = tmp_path / f"m{formats.FORMATS[name].suffix}"
        formats.export(dbn, path, format=name)
        assert same(formats.read(path, format=name), dbn)


def test_a_failed_export_keeps_the_old_file(tmp_path, monkeypatch):
    from nesy.formats import csv_table

    path = tmp_path / "m.csv"
    path.write_text("precious")

    def broken(dbn):
        yield from ()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(csv_table, "parts", broken)
    with pytest.raises(UserError, match="No space"):
        formats.export(toy()[0], path)
    assert path.read_text() == "precious" and len(list(tmp_path.iterdir())) == 1
