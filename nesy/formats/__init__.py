"""Files of the 2DBN for other programs: one module per format, read back where that makes sense."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

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


def export(
    dbn: TwoSliceDBN,
    path: Path | str,
    format: str | None = None,
    *,
    cone: Iterable[int] | None = None,
    known: float | None = None,
    **options: Any,
) -> None:
    """Write a model in one of `FORMATS`.

    Args:
        dbn: the model.
        path: where to write; a file, or a folder for `native`.
        format: a key of `FORMATS`; by default the one that the path's ending tells.
        cone: write only these factors and what they depend on (nesy.dbn.parts.cone_of); a `start` among the options
            and a `goal` are those of the whole model.
        known: write only the rows met, their entries from this probability on, the rest as one more value of every
            factor (nesy.dbn.parts.known_part).
        options: what the format's `write` takes besides (a start, goals, ...).

    Raises:
        UserError: no such format, or the model has something that the format cannot hold.
    """
    path = Path(path)
    name = format_of(path, format)
    if FORMATS[name].suffix and path.is_dir():
        raise UserError(f"{path}: is a folder; the format '{name}' is one file")
    write = _module(name).write
    for option in options:
        if option not in inspect.signature(write).parameters:
            raise UserError(f"{path}: the format '{name}' has no place for the option '{option}'")
    if cone is not None:
        dbn, options = _cut(dbn, cone, options)
    if known is not None:
        from nesy.dbn.parts import known_part

        dbn = known_part(dbn, known)
    try:
        write(dbn, path, **options)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from None


def _cut(dbn: TwoSliceDBN, cone: Iterable[int], options: dict[str, Any]) -> tuple[TwoSliceDBN, dict[str, Any]]:
    """The cone of influence, and the options in its factors."""
    from nesy.dbn.parts import cone_of

    part = cone_of(dbn, cone)
    kept = [dbn.factor_names.index(name) for name in part.factor_names]
    moved = dict(options)
    if options.get("start") is not None:
        moved["start"] = np.asarray(options["start"])[kept]
    if options.get("goals") is not None:
        moved["goals"] = np.unique(np.asarray(options["goals"])[:, kept], axis=0)
    if options.get("factors") is not None:
        moved["factors"] = [kept.index(i) for i in options["factors"]]
    if options.get("goal"):
        moved["goal"] = {kept.index(i): value for i, value in options["goal"].items()}
    return part, moved


def read(path: Path | str, format: str | None = None) -> TwoSliceDBN:
    """Read a model that `export` wrote.

    Raises:
        UserError: no such file or format, a format that cannot be read back, or a damaged file.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder")
    name = format_of(path, format)
    if not FORMATS[name].readable:
        known = ", ".join(key for key, f in FORMATS.items() if f.readable)
        raise UserError(f"{path}: the format '{name}' cannot be read back; these can: {known}")
    dbn: TwoSliceDBN = _module(name).read(path)
    return dbn


def format_of(path: Path, format: str | None) -> str:
    """The key of `FORMATS` that a format's name or a path's ending tells.

    Raises:
        UserError: there is none.
    """
    if format is None:
        format = next((key for key, f in FORMATS.items() if f.suffix == path.suffix.lower()), None)
        if format is None:
            known = ", ".join(f"{key} ({f.suffix or 'no ending'})" for key, f in FORMATS.items())
            raise UserError(f"{path}: no format has the ending '{path.suffix}'; the formats are {known}")
    if format not in FORMATS:
        raise UserError(f"no format '{format}'; the formats are {', '.join(FORMATS)}")
    return format


def name_of(format: str, text: str) -> str:
    """The name that a file of some format writes as `text`: `name_of("rddl", "do_go_x20left")` is "go left".

    Of PRISM's moves, PDDL's steps and the nodes of slice t+1 in jgum and BIF it is the name before what the file adds.
    In `graphml`, `dot` and the parents of `csv` and `parquet` a stroke marks slice t+1.

    Raises:
        UserError: no such format.
    """
    module = _module(format_of(Path(), format))
    return str(module.NAMES.decode(text)) if hasattr(module, "NAMES") else text


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"nesy.formats.{FORMATS[name].module}")
