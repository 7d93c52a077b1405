"""Damaged versions of good files, for scripts/fuzz_loaders.py: bytes, JSON values, arrays, columns, payloads."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_AWKWARD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**63, -(2**70), 10**400, 1e308, -0.5, "", "x", "\x00", "../../etc/passwd", [], {},
    [[]], [0] * 1000, {"format": 1}, "é\ud83d",
)  # fmt: skip


def mutate(path: Path, content: bytes, rng: np.random.Generator, canary: Path) -> tuple[str, bytes]:
    """A damaged version of a file, and how it was damaged."""
    kinds: list[tuple[str, Callable[[], bytes]]] = [
        ("bytes", lambda: _bytes(content, rng)),
        ("cut", lambda: content[: int(rng.integers(len(content) + 1))]),
        ("spliced", lambda: _spliced(content, rng)),
        ("payload", lambda: _payload(path, content, rng, canary)),
    ]
    if path.suffix in (".json", ".jgum"):
        kinds += [("json", lambda: _json(path, content, rng))] * 4
    if path.suffix == ".jgum":
        kinds += [("model", lambda: _jgum(content, rng))] * 4
    if path.suffix == ".npz":
        kinds += [("array", lambda: _npz(content, rng))] * 3
    if path.suffix == ".parquet":
        kinds += [("column", lambda: _column(content, rng))] * 3
        kinds += [("metadata", lambda: _metadata(content, rng))] * 3
    if path.suffix == ".safetensors":
        kinds += [("header", lambda: _header(content, rng))] * 3
    if path.suffix in (".lp", ".pomdp"):
        kinds += [("words", lambda: _words(content, rng))] * 4
    name, make = kinds[int(rng.integers(len(kinds)))]
    return name, make()


def _bytes(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
    return bytes(changed)


def _spliced(content: bytes, rng: np.random.Generator) -> bytes:
    a, b, c = sorted(int(rng.integers(len(content) + 1)) for _ in range(3))
    return (
        content[:a] + content[b:],
        content[:b] + content[a:],
        content[:a] + content[b:c] + content[a:b] + content[c:],
        content[:a] + bytes(b - a) + content[b:],
        b"",
    )[int(rng.integers(5))]


class _Hurt:
    """Unpickled, it leaves a file behind."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.canary), "w"))


def _payload(path: Path, content: bytes, rng: np.random.Generator, canary: Path) -> bytes:
    if path.suffix == ".lp":
        script = f"#script (python)\nopen({str(canary)!r}, 'w')\n#end.\n".encode()
        lua = f"#script (lua)\nio.open({json.dumps(str(canary))}, 'w')\n#end.\n".encode()
        include = b'#include "/etc/passwd".\n'
        return content + (script, lua, include)[int(rng.integers(3))]
    poison = pickle.dumps(_Hurt(canary))
    if path.suffix == ".npz":
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("tables.npy", poison)
        return (poison, buffer.getvalue())[int(rng.integers(2))]
    return (poison, content + poison)[int(rng.integers(2))]


def _json(path: Path, content: bytes, rng: np.random.Generator) -> bytes:
    """One value somewhere replaced, doubled or removed; the checksum of a sealed document is made to fit again."""
    from nesy.dbn import storage

    document = json.loads(content)
    sealed = isinstance(document, dict) and document.pop("checksum", None) is not None
    place: Any = document
    for _ in range(int(rng.integers(1, 6))):
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            break
        key = keys[int(rng.integers(len(keys)))]
        if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.7:
            place = place[key]
            continue
        kind = int(rng.integers(4))
        if kind == 0 and isinstance(place, dict):
            del place[key]
        elif kind == 1 and isinstance(place, list):
            place.append(place[key])
        elif kind == 2 and isinstance(place[key], int) and not isinstance(place[key], bool):
            place[key] += int(rng.integers(-3, 4))
        else:
            place[key] = _AWKWARD[int(rng.integers(len(_AWKWARD)))]
        break
    if sealed and rng.random() < 0.9:
        try:
            return storage._seal(document)
        except (ValueError, UnicodeError):
            pass
    return json.dumps(document, ensure_ascii=True).encode()


def _npz(content: bytes, rng: np.random.Generator) -> bytes:
    """One array with other numbers, another shape or another type; see `fit_checksum` for the checksum."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = list(arrays)[int(rng.integers(len(arrays)))]
    array = arrays[name].copy()
    kind = int(rng.integers(6))
    if kind == 0 and array.size:
        flat = array.reshape(-1).view(np.uint8)
        flat[rng.integers(len(flat), size=4)] = rng.integers(256, size=4)
    elif kind == 1:
        array = array[:-1] if array.ndim and len(array) else array
    elif kind == 2:
        array = array.astype((np.float32, np.int64, np.uint8, np.complex128, "U4")[int(rng.integers(5))])
    elif kind == 3:
        array = array.reshape(-1)
    elif kind == 4 and array.dtype.kind == "f" and array.size:
        array.reshape(-1)[int(rng.integers(array.size))] = (np.nan, np.inf, -1.0, 1e300)[int(rng.integers(4))]
    else:
        del arrays[name]
        array = np.zeros(0)
    if name in arrays:
        arrays[name] = array
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key, value in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(value), allow_pickle=False)
            archive.writestr(f"{key}.npy", member.getvalue())
    return buffer.getvalue()


def _column(content: bytes, rng: np.random.Generator) -> bytes:
    """One Parquet column renamed, dropped, doubled, of another type, or with other values."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(content))
    i = int(rng.integers(table.num_columns))
    name, column = table.column_names[i], table.column(i)
    kind = int(rng.integers(5))
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.rename_columns([f"{n}x" if j == i else n for j, n in enumerate(table.column_names)])
    elif kind == 2:
        table = table.set_column(i, name, pa.array([str(_AWKWARD[int(rng.integers(6))])] * table.num_rows))
    elif kind == 3:
        table = table.set_column(i, name, pa.nulls(table.num_rows, column.type))
    elif pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        values = column.to_numpy().copy()
        values[rng.integers(len(values), size=3)] = (0, 100, 127)[int(rng.integers(3))]
        table = table.set_column(i, name, pa.array(values, column.type))
    else:
        table = table.slice(0, int(rng.integers(table.num_rows)))
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _jgum(content: bytes, rng: np.random.Generator) -> bytes:
    """A jgum file with one value of its network or of its description replaced, under a checksum that fits."""
    from nesy.formats import jgum

    document = json.loads(content)
    properties = document["properties"]
    if rng.random() < 0.7:
        properties[jgum.PROPERTY] = _json(Path("x.json"), properties[jgum.PROPERTY].encode(), rng).decode()
    else:
        document = json.loads(_json(Path("x.json"), content, rng))
        document.setdefault("properties", properties)
    return jgum.sealed(json.dumps(document).encode())


def _metadata(content: bytes, rng: np.random.Generator) -> bytes:
    """A Parquet file with one value of its description replaced, under a checksum that fits."""
    import pyarrow.parquet as pq

    from nesy.formats import parquet

    table = pq.read_table(io.BytesIO(content))
    metadata = dict(table.schema.metadata or {})
    if parquet.KEY in metadata:
        metadata[parquet.KEY] = text = _json(Path("x.json"), metadata[parquet.KEY], rng)
        k = json.loads(text).get("num_values")
        if type(k) is int and k > 0 and table.num_rows % k == 0:
            probabilities, counts = (table[name].to_numpy().reshape(-1, k) for name in ("probability", "count"))
            metadata[parquet.SUM] = parquet.digest(text, probabilities, counts[:, 0]).encode()
    else:
        metadata[b"" if rng.random() < 0.1 else b"nesy"] = b"\xff"
    buffer = io.BytesIO()
    pq.write_table(table.replace_schema_metadata(metadata or {b"x": b""}), buffer)
    return buffer.getvalue()


def _header(content: bytes, rng: np.random.Generator) -> bytes:
    """A safetensors header with one value replaced."""
    length = int.from_bytes(content[:8], "little")
    header = _json(Path("x.json"), content[8 : 8 + length], rng)
    return len(header).to_bytes(8, "little") + header + content[8 + length :]


def _words(content: bytes, rng: np.random.Generator) -> bytes:
    words = content.decode().split(" ")
    pool = (
        *words,
        "*",
        "-1",
        "1e999",
        "nan",
        "99999999999",
        ":",
        "#include",
        "{",
        "1..10000000.",
        "not",
        "\n",
        "X",
        "(",
    )
    for _ in range(int(rng.integers(1, 4))):
        i = int(rng.integers(len(words)))
        words[i] = pool[int(rng.integers(len(pool)))]
    return " ".join(words).encode()


def fit_checksum(path: Path, content: bytes, written: dict[Path, bytes]) -> None:
    """Let the document beside a changed .npz name its new checksum, so that the loader looks inside."""
    from nesy.dbn import storage

    beside = next((p for p in path.parent.glob("*.json") if path.name.encode() in p.read_bytes()), None)
    if beside is None:
        return
    document = json.loads(beside.read_bytes())
    tables = document.get("tables")
    if isinstance(tables, dict) and "sha256" in tables and document.pop("checksum", None) is not None:
        written[beside] = beside.read_bytes()
        tables["sha256"] = hashlib.sha256(content).hexdigest()
        beside.write_bytes(storage._seal(document))
