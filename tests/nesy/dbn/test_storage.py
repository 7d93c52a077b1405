"""Saving and loading: bit-equal, and every damage found."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.dbn.rows import distinct_rows
from nesy.errors import UserError
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.toy import toy


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dbn")
    dbn, codebook = toy()
    dbn.save(folder)
    codebook.save(folder)
    return folder


def same(left: TwoSliceDBN, right: TwoSliceDBN) -> bool:
    texts = ("factor_names", "num_values", "action_names", "parents_now", "parents_next", "order", "value_meanings")
    arrays = ("probabilities", "row_counts", "initial", "offsets")
    return (
        all(getattr(left, name) == getattr(right, name) for name in texts)
        and left.provenance == right.provenance
        and all(np.array_equal(getattr(left, name), getattr(right, name)) for name in arrays)
        and left.tables.keys() == right.tables.keys()
        and all(np.array_equal(left.tables[name], right.tables[name]) for name in left.tables)
        and left.step_tables.keys() == right.step_tables.keys()
        and all(left.step_tables[name].same_as(right.step_tables[name]) for name in left.step_tables)
    )


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1))
def test_round_trip_is_bit_equal(tmp_path, seed):
    dbn = random_dbn(np.random.default_rng(seed))
    dbn.save(tmp_path / str(seed))
    assert same(TwoSliceDBN.load(tmp_path / str(seed)), dbn)


def test_the_same_model_gives_the_same_bytes(saved, tmp_path):
    toy()[0].save(tmp_path)
    for name in ("model.json", "tables.npz"):
        assert (tmp_path / name).read_bytes() == (saved / name).read_bytes()


def test_codebook_round_trip(saved):
    before, after = toy()[1], Codebook.load(saved)
    for name in ("views", "codes", "counts", "predicates"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert after.predicate_names == before.predicate_names
    assert after.predicate_meanings == before.predicate_meanings


def load_both(folder):
    TwoSliceDBN.load(folder)
    Codebook.load(folder)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_damaged_byte_is_found(saved, tmp_path, data):
    folder = tmp_path / "copy"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(saved, folder)
    path = folder / data.draw(st.sampled_from(["model.json", "tables.npz", "codebook.json", "codebook.npz"]))
    content = bytearray(path.read_bytes())
    position = data.draw(st.integers(0, len(content) - 1))
    content[position] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        load_both(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["model.json", "tables.npz", "codebook.json", "codebook.npz"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_truncated_and_missing_files_are_found(saved, tmp_path, name, share):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError):
        load_both(folder)
    (folder / name).unlink()
    with pytest.raises(UserError, match="no such file"):
        load_both(folder)


def test_tables_of_another_model_are_found(saved, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    random_dbn(np.random.default_rng(0)).save(tmp_path / "other")
    shutil.copy(tmp_path / "other" / "tables.npz", folder)
    with pytest.raises(UserError, match="another model"):
        TwoSliceDBN.load(folder)


def forge(folder, change, arrays=None):
    """A hostile model: content changed, checksums right."""
    from nesy.dbn import storage

    document, tables = storage.load(folder, "model", "nesy-2dbn")
    document.pop("tables")
    change(document)
    storage.save(folder, "model", "tables", document, {**tables, **(arrays or {})})


HOSTILE = {
    "parents beyond N": lambda d: d["parents_now"][0][0].append(17),
    "negative parent": lambda d: d["parents_now"][0][0].append(-1),
    "too many rows": lambda d: d.update(num_values=4096),
    "no values": lambda d: d.update(num_values=0),
    "text for a number": lambda d: d.update(num_values="three"),
    "cycle in slice t+1": lambda d: d["parents_next"].__setitem__(0, [[1], [0], []]),
    "order missing": lambda d: d.pop("order"),
    "names no list": lambda d: d.update(factor_names="abc"),
    "names twice": lambda d: d.update(factor_names=["a", "a", "b"]),
    "another version": lambda d: d.update(version=99),
    "a list for parents": lambda d: d.update(parents_now=[1, 2]),
    "huge number": lambda d: d.update(num_values=10**400),
    "other number of rows": lambda d: d["parents_now"][0][0].append(0),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_descriptions_with_right_checksums_give_one_line(saved, tmp_path, what):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    forge(folder, HOSTILE[what])
    with pytest.raises(UserError) as caught:
        TwoSliceDBN.load(folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, 2.0])
def test_tables_that_are_no_distributions_are_found(saved, tmp_path, value):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    table = toy()[0].probabilities.copy()
    table[0, 0] = value
    distinct, index = distinct_rows(table)
    forge(folder, lambda document: None, {"distinct_rows": distinct, "row_index": index})
    with pytest.raises(UserError, match="distribution"):
        TwoSliceDBN.load(folder)


def test_objects_in_the_tables_are_refused_and_run_nothing(saved, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    marker = tmp_path / "ran"

    class Evil:
        def __reduce__(self):
            return (marker.touch, ())

    np.savez(folder / "tables.npz", probabilities=np.array([Evil()], dtype=object))
    import hashlib

    from nesy.dbn import storage

    document = json.loads((folder / "model.json").read_text())
    document.pop("checksum")
    document["tables"]["sha256"] = hashlib.sha256((folder / "tables.npz").read_bytes()).hexdigest()
    (folder / "model.json").write_bytes(storage._seal(document))
    with pytest.raises(UserError, match="not a readable table file"):
        TwoSliceDBN.load(folder)
    assert not marker.exists()


def test_a_table_that_claims_to_be_huge_takes_no_memory(saved, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    content = (folder / "tables.npz").read_bytes()
    claimed = content.replace(b"'shape': (3, 3)", b"'shape': (9**9,")
    assert claimed != content
    (folder / "tables.npz").write_bytes(content.replace(b"(3, 3), }   ", b"(3, 3333),}"))
    with pytest.raises(UserError):
        TwoSliceDBN.load(folder)


def test_a_failed_save_keeps_the_old_model(saved, tmp_path, monkeypatch):
    folder = tmp_path / "copy"
    shutil.copytree(saved, folder)
    before = (folder / "model.json").read_bytes()
    from nesy.dbn import storage

    def full(document):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage, "_seal", full)
    with pytest.raises(OSError, match="No space"):
        toy()[0].save(folder)
    assert (folder / "model.json").read_bytes() == before
    assert not list(folder.glob(".*tmp*"))


def test_arrays_that_point_outside_are_found(saved, tmp_path):
    index = np.full(len(toy()[0].probabilities), 10**6, dtype=np.uint32)
    for arrays in ({"row_index": index}, {"met_rows": np.array([-1]), "met_counts": np.array([1])}):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        shutil.copytree(saved, folder)
        forge(folder, lambda document: None, arrays)
        with pytest.raises(UserError, match="does not describe"):
            TwoSliceDBN.load(folder)


def test_rows_never_met_take_little_room(tmp_path):
    rng = np.random.default_rng(0)
    table = np.full((8**5, 8), 1 / 8)
    table[rng.integers(8**5, size=100)] = rng.dirichlet(np.ones(8), size=100)
    dbn = TwoSliceDBN.from_tables([[table] * 8], [[list(range(5))] * 8])
    dbn.save(tmp_path)
    assert (tmp_path / "tables.npz").stat().st_size < dbn.probabilities.nbytes / 10
    assert same(TwoSliceDBN.load(tmp_path), dbn)
