"""CSV: the long table as text; probabilities with 17 digits, so that no bit is lost."""

from __future__ import annotations

import csv
from pathlib import Path

from nesy.dbn.model import TwoSliceDBN
from nesy.formats.long_table import parts
from nesy.names import PRINTED, TEXT, Grammar
from nesy.run_folder import atomic_path

NAMES = Grammar(first=r"(?![\s=])" + PRINTED, others=r"(?![\s=])" + PRINTED, never=r"'(?=\Z)", suffix="'")
"""Names of the parents."""
COLUMNS = ("action", "factor", "parents", "value", "probability", "count")


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` to the file `path`; `parents` reads like `X1=3 X4'=0`."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for part in parts(dbn):
            action, factor = TEXT.encode(dbn.action_names[part.action]), TEXT.encode(dbn.factor_names[part.factor])
            names = [NAMES.encode(dbn.factor_names[p]) + "'" * s for s, p in dbn.parents(part.action, part.factor)]
            rows = zip(part.parent_values.tolist(), part.probabilities.tolist(), part.counts.tolist(), strict=True)
            for values, row, count in rows:
                given = " ".join(f"{name}={v}" for name, v in zip(names, values, strict=True))
                writer.writerows((action, factor, given, k, repr(p), count) for k, p in enumerate(row))
