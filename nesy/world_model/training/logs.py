"""Logs of a training: metrics.jsonl, one line per epoch, and the same for TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any

from nesy.report.text import flat
from nesy.run_folder import atomic_path


class MetricsLog:
    """Writes one record per epoch; records after the checkpoint a training goes on from are dropped first."""

    def __init__(self, folder: Path, keep: int) -> None:
        """Open the log.

        Args:
            folder: gets metrics.jsonl and tensorboard/.
            keep: number of epochs that are already done.
        """
        from torch.utils.tensorboard import SummaryWriter

        self.path = folder / "metrics.jsonl"
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() and keep else []
        with atomic_path(self.path) as temporary:
            temporary.write_text("".join(line + "\n" for line in lines[:keep]), encoding="utf-8")
        self._stream = self.path.open("a", encoding="utf-8")
        self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=keep + 1)

    def write(self, tick: int, figures: dict[str, Any]) -> None:
        """Append the figures of epoch `tick`, counted from 1."""
        self._stream.write(json.dumps({"tick": tick, **figures}) + "\n")
        self._stream.flush()
        for name, value in flat(figures):
            if isinstance(value, int | float):
                self._writer.add_scalar(f"{figures['stage']}/{name}", value, tick)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()
        self._writer.close()
