"""The `.pomdp` reader and writer: every form of the grammar, names, and time linear in the file."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nesy.errors import UserError
from planners.explicit.pomdp import TabularPOMDP
from planners.explicit.pomdp_entries import Entries, _transitions
from planners.explicit.pomdp_file import escape, unescape

PREAMBLE = "discount: 0.9\nvalues: reward\nstates: wet dry frozen\nactions: wait pump\nobservations: low high\n"
TABLES = "T: * identity\nO: * uniform\nR: pump : wet : * : * 1\n"
# The reserved words of pomdp-solve's scanner (scanner.l).
RESERVED = ["discount", "values", "states", "actions", "observations", "T", "O", "R", "uniform", "identity"]
RESERVED += ["reward", "cost", "start", "include", "exclude", "reset"]


def _read(folder: Path, text: str | bytes) -> TabularPOMDP:
    path = folder / "m.pomdp"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return TabularPOMDP.from_file(path)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param((PREAMBLE + TABLES).encode("utf-8-sig"), id="UTF-8 with byte order mark"),
        pytest.param((PREAMBLE + TABLES).encode("utf-16"), id="UTF-16"),
        pytest.param((PREAMBLE + TABLES).replace("\n", "\r\n"), id="Windows line ends"),
        pytest.param((PREAMBLE + TABLES).replace(" ", "\t").replace(":", "\t:\n\t"), id="tabs, entries over lines"),
        pytest.param((PREAMBLE + TABLES).replace(" : ", ":").replace(": ", ":"), id="no spaces around colons"),
        pytest.param((PREAMBLE + TABLES).replace("\n", "# gr\xfc\xdfe: T: O: R:\n").encode("latin-1"), id="comments"),
        pytest.param((PREAMBLE + TABLES).replace("\n", " # a\x0cb\u2028 T: * 1\n"), id="form feeds in comments"),
        pytest.param((PREAMBLE + TABLES).replace("values: reward", "values: rewards"), id="rewards"),
        pytest.param((PREAMBLE + TABLES).replace("reward", "cost").replace("* 1\n", "* -1\n"), id="cost"),
        pytest.param(
            (PREAMBLE + TABLES).replace("reward", "costs").replace("* 1\n", "* - 1\n"), id="costs, sign apart"
        ),
        pytest.param((PREAMBLE + TABLES).replace("* 1\n", "*+1\n"), id="sign behind the asterisk"),
        pytest.param((PREAMBLE + TABLES).replace("* 1\n", "* : 1\n"), id="colon before the number"),
        pytest.param((PREAMBLE + TABLES).replace("pump : wet : * : * 1", "1:0:*:* 1.e0"), id="places for names"),
        pytest.param((PREAMBLE + TABLES).replace(" : * : * 1", "\n+ 1+1 1\n1 + 1 1"), id="a matrix with signs"),
    ],
)
def test_forms_of_one_model(tmp_path: Path, text: str | bytes) -> None:
    model = _read(tmp_path, text)
    assert (model.states, model.actions) == (("wet", "dry", "frozen"), ("wait", "pump"))
    assert model.observations == ("low", "high")
    assert model.reward.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert all((matrix.toarray() == np.eye(3)).all() for matrix in model.transition)
    assert (model.observation == 0.5).all()
    assert model.discount == 0.9


@pytest.mark.parametrize(
    ("start", "wanted"),
    [
        ("", [1 / 3, 1 / 3, 1 / 3]),
        ("start: uniform\n", [1 / 3, 1 / 3, 1 / 3]),
        ("start: dry\n", [0, 1, 0]),
        ("start:\n2\n", [0, 0, 1]),
        ("start: 0.25 .25 5e-1\n", [0.25, 0.25, 0.5]),
        ("start include: wet 2\n", [0.5, 0, 0.5]),
        ("start exclude : wet\n", [0, 0.5, 0.5]),
        ("start: 0 1 0 # or\n", [0, 1, 0]),
    ],
)
def test_starts(tmp_path: Path, start: str, wanted: list[float]) -> None:
    assert _read(tmp_path, PREAMBLE + start + TABLES).start.tolist() == wanted


@pytest.mark.parametrize("start", ["start: only\n", "start: 0\n", "start: 1\n", "start: 1.0\n", "start: uniform\n"])
def test_one_state(tmp_path: Path, start: str) -> None:
    text = f"discount: 0.9\nvalues: reward\nstates: only\nactions: go\nobservations: seen\n{start}"
    model = _read(tmp_path, f"{text}T: go identity\nO: go uniform\nR: go : only : * : * 1\n")
    assert (model.start.tolist(), model.reward.tolist()) == ([1.0], [[1.0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PREAMBLE + "horizon: 10\n" + TABLES, "line 6: unknown word 'horizon' in the preamble; it takes discount,"),
        (PREAMBLE.replace("high", "high horizon : 10") + TABLES, "line 5: unknown word 'horizon'"),
        ("episodes: 5\n" + PREAMBLE + TABLES, "line 1: unknown word 'episodes'"),
        (PREAMBLE.replace("states", "States") + TABLES, "line 3: unknown word 'States' in the preamble; did you mean"),
        (PREAMBLE + "states: a b\n" + TABLES, "line 6: 'states:' is there twice"),
        (PREAMBLE.replace("wet", "*") + TABLES, "line 3: expected a name, found '*'"),
        (PREAMBLE.replace("values: reward", "values: money") + TABLES, "line 2: values are 'reward' or 'cost'"),
        (PREAMBLE + "start: wet dry\n" + TABLES, "line 6: 'start:' takes a state, 'uniform' or a probability for each"),
        (PREAMBLE + "start: wet dry\n" + TABLES, "several states are listed after 'start include:'"),
        (PREAMBLE + "start: 0.5 0.5\n" + TABLES, "each of the 3 states, found 2 numbers"),
        (PREAMBLE + TABLES + "discount: 0.5\n", "line 9: expected 'T:', 'O:' or 'R:', found 'discount'"),
        (PREAMBLE + TABLES.replace("* 1", "* - -1"), "line 8: expected a number, found '-1'"),
        (PREAMBLE + TABLES.replace("* 1", "* 1_0"), "line 8: expected a number, found '1_0'"),
        (PREAMBLE + TABLES.replace("* 1", "* inf"), "line 8: expected a number, found 'inf'"),
        (PREAMBLE + TABLES.replace("* 1", ""), "line 8: the file ends in the middle of an entry"),
        (PREAMBLE + TABLES.replace("T: *", "T: wait"), "transitions of action 'pump' in state 'wet' sum to 0, not 1"),
        (PREAMBLE + TABLES + "T: wait : dry : dry -1\n", "action 'wait' in state 'dry' hold a negative number"),
        (
            '<?xml version="1.0"?>\n<pomdpx>\n</pomdpx>\n',
            "line 1: this is XML (POMDPX?); only Cassandra's .pomdp format",
        ),
        ("", "line 1: the preamble lacks 'states:'"),
    ],
)
def test_what_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"m\.pomdp") as caught:
        _read(tmp_path, text)
    assert message in str(caught.value)


def test_words_of_the_format_as_names_of_others(tmp_path: Path) -> None:
    """Files that our own writer made once, and names that pomdp-solve would refuse."""
    text = PREAMBLE.replace("wait pump", "reset uniform").replace("wet dry", "start 1a").replace("low", "T")
    model = _read(tmp_path, text + "start: 1a\nT: reset identity\nT: uniform uniform\nO: * uniform\n")
    assert model.states == ("start", "1a", "frozen")
    assert model.actions == ("reset", "uniform")
    assert model.observations == ("T", "high")
    assert model.start.tolist() == [0, 1, 0]


SIZES = {"a": 2, "s": 3, "o": 2}


@st.composite
def _entries(draw: st.DrawFn) -> list[tuple[str, tuple[int | None, ...], np.ndarray]]:
    """Entries of T, O and R: the table, where (None: `*`), and the values of the coordinates that are left."""
    found = []
    for _ in range(draw(st.integers(0, 12))):
        table = draw(st.sampled_from("TOR"))
        axes = {"T": "ass", "O": "aso", "R": "asso"}[table]
        given_axes = draw(st.integers(2 if table == "R" else 1, len(axes)))
        where = tuple(draw(st.none() | st.integers(0, SIZES[axis] - 1)) for axis in axes[:given_axes])
        shape = tuple(SIZES[axis] for axis in axes[given_axes:])
        numbers = st.integers(-3, 3) if table == "R" else st.integers(0, 2)
        values = draw(st.lists(numbers, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
        found.append((table, where, np.array(values, float).reshape(shape)))
    return found


@settings(
    max_examples=100, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(_entries(), st.integers(0, 2**31))
def test_entries_in_any_order_against_dense_tables(
    tmp_path: Path, entries: list[tuple[str, tuple[int | None, ...], np.ndarray]], seed: int
) -> None:
    """Every wildcard pattern, row and matrix, on top of a full model, painted into dense arrays beside."""
    a, s, o = SIZES.values()
    dense = {"T": np.zeros((a, s, s)), "O": np.zeros((a, s, o)), "R": np.zeros((a, s, s, o))}
    rng = np.random.default_rng(seed)
    lines = [f"discount: 0.9\nvalues: reward\nstates: {s}\nactions: {a}\nobservations: {o}"]
    rows = [("T", (i, j), rng.dirichlet(np.full(s, 0.5)).round(4)) for i in range(a) for j in range(s)]
    rows += [("O", (i, j), rng.dirichlet(np.full(o, 0.5)).round(4)) for i in range(a) for j in range(s)]
    for table, where, values in [*entries, *rows] if rng.random() < 0.5 else [*rows, *entries]:
        lines.append(f"{table}: " + " : ".join("*" if i is None else str(i) for i in where))
        lines.append(" ".join(repr(float(v)) for v in values.reshape(-1)))
        dense[table][tuple(slice(None) if i is None else i for i in where)] = values
    sums = {table: dense[table].sum(axis=-1, keepdims=True) for table in "TO"}
    if any((abs(total - 1) > 1e-3).any() for total in sums.values()):
        with pytest.raises(UserError, match="sum to"):
            _read(tmp_path, "\n".join(lines))
        return
    model = _read(tmp_path, "\n".join(lines))
    transition, observation = dense["T"] / sums["T"], dense["O"] / sums["O"]
    assert np.allclose([matrix.toarray() for matrix in model.transition], transition, atol=1e-12)
    assert np.allclose(model.observation, observation, atol=1e-12)
    assert np.allclose(model.reward, np.einsum("ast,ato,asto->as", transition, observation, dense["R"]), atol=1e-12)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(_entries())
def test_transitions_in_any_order_against_dense_tables(
    entries: list[tuple[str, tuple[int | None, ...], np.ndarray]],
) -> None:
    """As above for tables whose rows need not sum to 1."""
    a, s, _ = SIZES.values()
    table, dense = Entries((a, s, s)), np.zeros((a, s, s))
    for kind, where, values in entries:
        if kind == "T":
            dense[tuple(slice(None) if i is None else i for i in where)] = values
            if values.ndim:
                table.put_block(where, np.nonzero(values), values[np.nonzero(values)])
            else:
                table.put(where, float(values))
    assert np.array_equal([_transitions(table, action, s, "m").toarray() for action in range(a)], dense)


SPARSE = [
    f"T: {a} : {s} : {(7 * s + j * (a + 1)) % 2653} 0.25" for a in range(6) for s in range(2653) for j in range(4)
]


@pytest.mark.parametrize(
    ("where", "tables"),
    [
        ("R: {a} : * : {s} : *", SPARSE),
        ("R: * : {s} : {t} : {o}", SPARSE),
        ("R: * : * : {s} : {o}", [*SPARSE, "R: 0 : 1 : 2 : 3 4"]),
        ("R: {a} : {s} : * : *", ["T: * uniform", "R: * : 5 : 7 : * 1"]),
        ("T: {a} : * : {s}", ["T: * identity"]),
    ],
)
def test_reading_time_is_linear(tmp_path: Path, where: str, tables: list[str]) -> None:
    """2,653 states and 15,918 lines; those of rewards on arrival took minutes."""
    lines = ["discount: 0.9", "values: reward", "states: 2653", "actions: 6", "observations: 40", "O: * uniform"]
    cells = [(a, s) for a in range(6) for s in range(2653)]
    body = [where.format(a=a, s=s, t=(7 * s + a + 1) % 2653, o=s % 40) for a, s in cells]
    if where.startswith("T"):
        text = "\n".join([*lines, *(f"{line} 0.5" for line in body), *tables])
    else:
        text = "\n".join([*lines, *tables, *(f"{line} {i % 7}" for i, line in enumerate(body))])
    began = time.process_time()
    model = _read(tmp_path, text)
    assert time.process_time() - began < 15  # 1 to 2 s
    assert model.reward.any() == where.startswith("R")


@settings(
    max_examples=100, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.sampled_from([*RESERVED, "", "5", "go left", "go-left", "a:b", "n_0x_", "_0x20_", "x_0x20", "#", "*", "-"])
        | st.text(st.characters(exclude_categories=[]), max_size=6)
        | st.text("n_0x5f2 ", max_size=12),
        min_size=2,
        max_size=6,
        unique=True,
    )
)
def test_any_names_come_back(tmp_path: Path, names: list[str]) -> None:
    words = [escape(name) for name in names]
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", word) for word in words)
    assert not set(words) & set(RESERVED)
    assert len(set(words)) == len(words)
    assert [unescape(word) for word in words] == names
    count = len(names)
    model = TabularPOMDP(
        states=names,
        actions=names[::-1],
        observations=names[1:],
        transition=[np.eye(count)[::-1]] * count,
        observation=np.full((count, count, count - 1), 1 / (count - 1)),
        reward=np.arange(count * count, dtype=float).reshape(count, count),
        discount=np.float64(0.9),
        start=np.eye(count)[0],
        terminal=np.zeros(count, np.bool_),
    )
    model.to_file(tmp_path / "m.pomdp")
    again = TabularPOMDP.from_file(tmp_path / "m.pomdp")
    assert (again.states, again.actions, again.observations) == (tuple(names), tuple(names[::-1]), tuple(names[1:]))
    assert (again.reward == model.reward).all()
    _check_scanner((tmp_path / "m.pomdp").read_text())


def _check_scanner(text: str) -> None:
    """Every token is one of pomdp-solve's scanner, and the name lists hold names alone or one number."""
    token = re.compile(r"[A-Za-z][A-Za-z0-9_-]*|\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|[*+:-]|[ \t\r\n]|#[^\n]*", re.ASCII)
    at = 0
    while at < len(text):
        found = token.match(text, at)
        assert found is not None, text[at : at + 20]
        at = found.end()
    for kind in ("states", "actions", "observations"):
        listed = re.search(f"^{kind}: (.*)$", text, re.MULTILINE)
        assert listed is not None
        words = listed[1].split(" ")
        assert words[0].isdecimal() if len(words) == 1 and words[0][0].isdigit() else not set(words) & set(RESERVED)


def test_plain_names_are_written_as_they_are(tmp_path: Path) -> None:
    model = _read(tmp_path, PREAMBLE + TABLES)
    model.to_file(tmp_path / "m.pomdp")
    assert (tmp_path / "m.pomdp").read_text().startswith("discount: 0.9\nvalues: reward\nstates: wet dry frozen\n")
    assert escape("go_north-1") == "go_north-1"
    assert escape("go left") == "go_0x20_left"
    assert escape("reset") == "n_0x_reset"


def test_escapes_of_others_stay_as_they_are(tmp_path: Path) -> None:
    model = _read(tmp_path, PREAMBLE.replace("wet", "a_0x20_b") + TABLES.replace("wet", "0"))
    assert model.states[0] == "a_0x20_b"
