"""The project's own format: a folder with model.json and tables.npz (see nesy.dbn.model)."""

from __future__ import annotations

from pathlib import Path

from nesy.dbn.model import TwoSliceDBN


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` into the folder `path`."""
    dbn.save(path)


def read(path: Path) -> TwoSliceDBN:
    """Read the folder `path`.

    Raises:
        UserError: damaged files.
    """
    return TwoSliceDBN.load(path)
