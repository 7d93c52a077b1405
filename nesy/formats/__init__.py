"""Files of the 2DBN for other programs: one module per format, read back where that makes sense."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError


@dataclass(frozen=True)
class Format:
    """One file format."""

    module: str
    """The module with `write(dbn, path)` and, where it can be read, `read(path)`."""
    suffix: str
    """The ending that tells the format; empty for a folder."""
    readable: bool
    """Whether a model can be read back."""
    purpose: str
    """What it is for."""


FORMATS: dict[str, Format] = {
    "native": Format("native", "", True, "a folder with model.json and tables.npz; bit-equal when read back"),
    "parquet": Format("parquet", ".parquet", True, "one row per action, factor, parents' values and value"),
    "csv": Format("csv_table", ".csv", False, "the same as text"),
    "jgum": Format("jgum", ".jgum", True, "pyAgrum: one Bayesian network, a copy of slice t+1 per action; bit-equal"),
    "bif": Format("bif", ".bif", False, "the same for any Bayesian network tool, nine digits"),
    "prism": Format("prism", ".prism", False, "Storm and PRISM: one module per factor, synchronised on the action"),
    "rddl": Format("rddl", ".rddl", False, "pyRDDLGym; the instance goes into NAME_instance.rddl beside it"),
    "pddl": Format("pddl", ".pddl", False, "classical planners: most probable outcomes, with NAME_problem.pddl"),
    "graphml": Format("graphml", ".graphml", False, "the graph for Gephi, yEd and networkx"),
    "dot": Format("dot", ".dot", False, "the graph for Graphviz"),
    "asp": Format("asp_facts", ".lp", False, "facts for clingo (vocabulary: docs/asp.md)"),
}


def export(dbn: TwoSliceDBN, path: Path | str, format: str | None = None, **options: Any) -> None:
    """Write a model in one of `FORMATS`.

    Args:
        dbn: the model.
        path: where to write; a file, or a folder for `native`.
        format: a key of `FORMATS`; by default the one that the path's ending tells.
        options: what the format's `write` takes besides (a start, goals, ...).

    Raises:
        UserError: no such format, or the model has something that the format cannot hold.
    """
    path = Path(path)
    name = _format_of(path, format)
    if FORMATS[name].suffix and path.is_dir():
        raise UserError(f"{path}: is a folder; the format '{name}' is one file")
    try:
        _module(name).write(dbn, path, **options)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from None


def read(path: Path | str, format: str | None = None) -> TwoSliceDBN:
    """Read a model that `export` wrote.

    Raises:
        UserError: no such file or format, a format that cannot be read back, or a damaged file.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder")
    name = _format_of(path, format)
    if not FORMATS[name].readable:
        known = ", ".join(key for key, f in FORMATS.items() if f.readable)
        raise UserError(f"{path}: the format '{name}' cannot be read back; these can: {known}")
    dbn: TwoSliceDBN = _module(name).read(path)
    return dbn


def _format_of(path: Path, format: str | None) -> str:
    if format is None:
        format = next((key for key, f in FORMATS.items() if f.suffix == path.suffix.lower()), None)
        if format is None:
            known = ", ".join(f"{key} ({f.suffix or 'no ending'})" for key, f in FORMATS.items())
            raise UserError(f"{path}: no format has the ending '{path.suffix}'; the formats are {known}")
    if format not in FORMATS:
        raise UserError(f"no format '{format}'; the formats are {', '.join(FORMATS)}")
    return format


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"nesy.formats.{FORMATS[name].module}")
