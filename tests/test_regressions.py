"""One test per fixed bug."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from domains.core import UNSEEN, load_domain
from nesy.errors import UserError


def test_a_crossing_step_tells_of_no_person() -> None:
    """What held of the person after a step of the crossing task was uninitialised memory."""
    env = load_domain().make("crossing", 64, seed=0)
    env.reset(seed=0)
    for _ in range(20):
        # arrays of these sizes, freed again, so that uninitialised memory would not be zero by luck
        scratch = [np.full(shape, 77, kind) for shape, kind in (((64, 5, 5), np.uint8), ((64, 3), np.int16))]
        del scratch
        _, _, _, _, infos = env.step(np.full(64, 2, np.int64))
        assert (infos["final_person_view"] == UNSEEN).all()
        assert (infos["final_relative_pose"] == 0).all()
        assert (infos["final_counters"] == 0).all()


def test_the_last_seen_follower_keeps_the_person_in_view() -> None:
    """Where the way to the last seen pose did not end in its heading, it lost the person: 85.3 instead of 90.5."""
    from planners.baselines import LastSeenFollower
    from planners.comparison.evaluation import Player, evaluate

    domain = load_domain()
    result = evaluate(domain, "paper", Player(LastSeenFollower(domain, "paper")), 42, seed=5)
    assert result["return"].mean() > 88


def test_a_pomdp_file_without_states_is_refused(tmp_path: Path) -> None:
    """`states:` with no name after it divided by zero at `start: uniform`."""
    from planners.explicit.pomdp import TabularPOMDP

    path = tmp_path / "empty.pomdp"
    path.write_text("discount: 0.9\nvalues: reward\nstates:\nactions: a\nobservations: o\nstart: uniform\n")
    with pytest.raises(UserError, match="'states:' names nothing"):
        TabularPOMDP.from_file(path)


def test_a_message_never_repeats_a_whole_file() -> None:
    """A stranger's list of a thousand parents was repeated in full."""
    message = str(UserError(f"model.json: {[0] * 5000} are not distinct factors"))
    assert len(message) <= 1000
    assert message.startswith("model.json: ")
    assert message.endswith("are not distinct factors")


def test_numbers_too_large_for_a_table_are_refused(tmp_path: Path) -> None:
    """A number of 400 digits in the description beside the columns ended in an OverflowError."""
    import pyarrow.parquet as pq

    from nesy.dbn import TwoSliceDBN
    from nesy.formats import export, parquet, read

    dbn = TwoSliceDBN.from_tables([[np.full((2, 2), 0.5)]], [[(0,)]])
    path = tmp_path / "model.parquet"
    export(dbn, path)
    table = pq.read_table(path)
    text = table.schema.metadata[parquet.KEY].replace(b'"initial": [[0.5', b'"initial": [[' + b"9" * 400)
    sha = parquet.digest(text, dbn.probabilities, dbn.row_counts).encode()
    pq.write_table(table.replace_schema_metadata({parquet.KEY: text, parquet.SUM: sha}), path)
    with pytest.raises(UserError, match="too large for a whole number"):
        read(path)


def test_a_table_file_cannot_have_any_name(tmp_path: Path) -> None:
    """A name with a null byte in a sealed model.json ended in a ValueError of `open`."""
    import json

    from nesy.dbn import TwoSliceDBN, storage

    TwoSliceDBN.from_tables([[np.full((2, 2), 0.5)]], [[(0,)]]).save(tmp_path)
    path = tmp_path / "model.json"
    document = json.loads(path.read_text())
    del document["checksum"]
    for name in ("\0", "../tables.npz"):
        document["tables"]["file"] = name
        path.write_bytes(storage._seal(document))
        with pytest.raises(UserError, match="names a table file outside its folder, or one that cannot be"):
            TwoSliceDBN.load(tmp_path)
