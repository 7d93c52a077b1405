"""A JSON file and an .npz file that belong together, with checksums, for data from strangers.

The JSON file holds the SHA-256 of the .npz file and of itself, so that a changed, swapped or truncated
byte in either is found. Arrays are stored uncompressed and without objects: reading runs no code, and
takes no more memory than the file is long.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from nesy.errors import UserError
from nesy.run_folder import atomic_path, parse_json

_LOCAL_HEADER = 30  # bytes of a zip member's local header before its name


def save(folder: Path, name: str, tables: str, document: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write `folder/name`.json with `document` and `folder/tables`.npz with `arrays`, each atomically."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tables_path = folder / f"{tables}.npz"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key in sorted(arrays):
            member = io.BytesIO()
            npy.write_array(member, np.ascontiguousarray(arrays[key]), allow_pickle=False)
            # a fixed date: the same model gives the same bytes
            archive.writestr(zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0)), member.getbuffer())
    content = buffer.getbuffer()
    complete = {
        **document,
        "tables": {"file": tables_path.name, "sha256": hashlib.sha256(content).hexdigest()},
    }
    with atomic_path(tables_path) as temporary:
        temporary.write_bytes(content)
    with atomic_path(folder / f"{name}.json") as temporary:
        temporary.write_bytes(_seal(complete))


def load(folder: Path, name: str, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `save` wrote; the arrays are read-only.

    Args:
        folder: where the two files are.
        name: the JSON file's name without its ending.
        kind: the document's `format` field.

    Raises:
        UserError: a file is missing, damaged, swapped, or of another kind.
    """
    path = Path(folder) / f"{name}.json"
    document = _read_sealed(path, kind)
    reference = document["tables"]
    tables_path = Path(folder) / str(reference["file"])
    if tables_path.parent != Path(folder) or not tables_path.name.isprintable():
        raise UserError(f"{path}: names a table file outside its folder, or one that cannot be")
    content = _read_bytes(tables_path)
    if hashlib.sha256(content).hexdigest() != reference["sha256"]:
        raise UserError(f"{tables_path}: damaged or from another model (its checksum differs from {path.name})")
    return document, _read_arrays(tables_path, content)


def _seal(document: dict[str, Any]) -> bytes:
    """The canonical text of `document` with the checksum of that text as its last field."""
    body = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    digest = hashlib.sha256(body.encode("utf-8")).hexdigest()
    return (body[: body.rindex("\n")] + f',\n "checksum": "{digest}"\n}}\n').encode()


def _read_sealed(path: Path, kind: str) -> dict[str, Any]:
    content = _read_bytes(path)
    try:
        document = parse_json(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(document, dict) or document.get("format") != kind:
        raise UserError(f"{path}: not a {kind} file")
    if document.pop("checksum", None) is None or not _is_sealed(document, content):
        raise UserError(f"{path}: damaged (its checksum does not match its content); extract the model again")
    tables = document.get("tables")
    if not (isinstance(tables, dict) and isinstance(tables.get("file"), str) and isinstance(tables.get("sha256"), str)):
        raise UserError(f"{path}: does not name its table file")
    return document


def _is_sealed(document: dict[str, Any], content: bytes) -> bool:
    try:
        return _seal(document) == content
    except ValueError:  # half a surrogate pair: nothing that we would have written
        return False


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; extract the model again (nesy extract --redo)") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None


def _read_arrays(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """All arrays of an uncompressed .npz file, as views of its bytes."""
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
                raise ValueError(f"unexpected member {member.filename!r}")
            name_length, extra_length = struct.unpack_from("<HH", content, member.header_offset + 26)
            start = member.header_offset + _LOCAL_HEADER + name_length + extra_length
            stream = io.BytesIO(content[start : start + min(member.file_size, 4096)])
            version = npy.read_magic(stream)
            if version != (1, 0):
                raise ValueError(f"array format {version} in {member.filename!r}")
            shape, fortran, dtype = npy.read_array_header_1_0(stream)
            length = int(np.prod(shape, dtype=object)) if shape else 1
            first = start + stream.tell()
            if dtype.hasobject or fortran or length * dtype.itemsize != member.file_size - stream.tell():
                raise ValueError(f"array {member.filename!r} does not fit its header")
            arrays[member.filename[:-4]] = np.frombuffer(content, dtype, length, first).reshape(shape)
    except (
        ValueError,
        struct.error,
        zipfile.BadZipFile,
        KeyError,
        NotImplementedError,
        OverflowError,
    ) as error:
        raise UserError(f"{path}: not a readable table file ({error})") from None
    return arrays
