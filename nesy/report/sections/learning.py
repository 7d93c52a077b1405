"""How the learning agents learned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nesy.errors import UserError
from nesy.report import figures
from nesy.report.html_pieces import figure
from nesy.run_folder import RunFolder

ANCHOR = "learning"
TITLE = "Learning curves"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """Learning curves of the agents that learn."""
    path = run.results / "episodes.parquet"
    columns = ["agent", "inputs", "influence", "variant", "seed", "phase", "episode", "return"]
    try:
        columns_read = pq.read_table(path, columns=columns, filters=[("phase", "=", "train")])
    except (OSError, pa.ArrowException) as error:
        raise UserError(
            f"{path}: not readable as Parquet ({type(error).__name__}); make it with: nesy compare"
        ) from None
    rows = columns_read.to_pydict()
    groups: dict[str, list[int]] = {}
    for position in range(columns_read.num_rows):
        name = " / ".join(str(rows[column][position]) for column in columns[:5] if column != "variant")
        groups.setdefault(name.replace(" / 0", "") if len(set(rows["seed"])) == 1 else name, []).append(position)
    if not groups:
        return "<p>No agent of this comparison learned.</p>"
    returns = np.asarray(rows["return"], dtype=np.float64)
    episodes = np.asarray(rows["episode"])
    curves = {name: returns[sorted(members, key=lambda i: episodes[i])] for name, members in groups.items()}
    optimum = next((cell["return"]["mean"] for cell in summary["comparison"] if cell["agent"] == "optimum"), None)
    window = 200
    return figure(
        figures.learning_curves(curves, optimum, window),
        f"Return of the training episodes, exploration included: mean of the last {window} episodes.",
        "Learning curves of the DQN",
    )
