"""A run: one folder that holds a whole experiment (layout: docs/formats.md), and atomic writes into it.

Nothing in a run folder is ever executed or unpickled, so a folder from a stranger is safe to open.
"""

from __future__ import annotations

import fcntl
import filecmp
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nesy.errors import UserError

# Some writers (safetensors) make files that only their owner can read; a run is as readable as any other file.
_UMASK = os.umask(0o022)
os.umask(_UMASK)
_FILE_MODE = 0o666 & ~_UMASK
_TEMPORARY = re.compile(r"\..*\.\d+\.tmp(\.[^.]*)?")
"""Names that `atomic_path` gives to files that are being written."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block ends without an exception.

    A reader sees the old file or the new one, never a half-written one; after an exception the old file
    stays and the temporary one is removed. A file that would stay as it is, byte by byte, is not touched.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        if path.is_file() and filecmp.cmp(temporary, path, shallow=False):
            return
        temporary.chmod(_FILE_MODE)
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: the file is missing or is not JSON of numbers that fit in 64 bits.
    """
    path = Path(path)
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error})") from None


def parse_json(text: str | bytes) -> Any:
    """JSON as we write it: whole numbers of at most 64 bits, no NaN or Infinity.

    Raises:
        ValueError: `text` is anything else.
    """
    return json.loads(text, parse_int=_whole_number, parse_constant=_no_number)


def _whole_number(digits: str) -> int:
    if len(digits) > 20 or not -(2**63) <= (value := int(digits)) < 2**63:
        raise ValueError(f"{digits[:20]}... is too large for a whole number")
    return value


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no number")


# step -> (what it leaves behind, the command that makes it); the order is that of the pipeline.
STEPS: dict[str, tuple[str, str]] = {
    "config": ("config.json", "nesy run"),
    "collect": ("experience/complete.json", "nesy collect"),
    "train": ("world_model/model.safetensors", "nesy train"),
    "extract": ("dbn/model.json", "nesy extract"),
    "compare": ("results/comparison.json", "nesy compare"),
    "report": ("report.html", "nesy report"),
}


@dataclass(frozen=True)
class RunFolder:
    """Paths inside one run folder, and which steps it holds."""

    path: Path

    @classmethod
    def open(cls, path: Path | str) -> RunFolder:
        """Open an existing run folder.

        Raises:
            UserError: there is no such folder, or it is no run folder.
        """
        path = Path(path)
        if not path.is_dir():
            raise UserError(f"{path}: no such run folder (make one with: nesy run --run {path})")
        run = cls(path)
        if not run.has("config"):
            raise UserError(f"{path}: not a run folder, config.json is missing (make one with: nesy run --run {path})")
        return run

    @property
    def config(self) -> Path:
        """Everything needed to repeat the run."""
        return self.path / "config.json"

    @property
    def experience(self) -> Path:
        """Transitions in columns, `part-*.parquet`."""
        return self.path / "experience"

    @property
    def world_model(self) -> Path:
        """The trained network and its metrics."""
        return self.path / "world_model"

    @property
    def dbn(self) -> Path:
        """The extracted 2DBN."""
        return self.path / "dbn"

    @property
    def ialm(self) -> Path:
        """Influence, observation, reward and termination tables."""
        return self.path / "ialm"

    @property
    def policies(self) -> Path:
        """One safetensors file per trained policy."""
        return self.path / "policies"

    @property
    def results(self) -> Path:
        """Episodes and comparison tables."""
        return self.path / "results"

    @property
    def summary(self) -> Path:
        """The figures of the comparison and of every gate, machine-readable."""
        return self.path / "summary.json"

    @property
    def report(self) -> Path:
        """The same for people."""
        return self.path / "report.html"

    def has(self, step: str) -> bool:
        """Whether `step` (a key of `STEPS`) has been completed."""
        return (self.path / STEPS[step][0]).is_file()

    def require(self, *steps: str) -> None:
        """Check that the run holds `steps`.

        Raises:
            UserError: a step is missing; the message names the command that makes it.
        """
        for step in steps:
            if not self.has(step):
                file, command = STEPS[step]
                raise UserError(
                    f"{self.path}: the run lacks the step '{step}' ({file} is missing); "
                    f"make it with: {command} --run {self.path}"
                )

    def read_summary(self) -> dict[str, Any]:
        """The summary so far; empty if no step has written one.

        Raises:
            UserError: the file is damaged.
        """
        if not self.summary.exists():
            return {}
        value = read_json(self.summary)
        if not isinstance(value, dict):
            raise UserError(f"{self.summary}: expected a JSON object, found {type(value).__name__}")
        return value

    def update_summary(self, **sections: Any) -> None:
        """Replace whole top-level sections of summary.json, atomically."""
        write_json(self.summary, {**self.read_summary(), **sections})

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run for writing; readers need no lock, since every file is replaced whole.

        Raises:
            UserError: another process is writing this run.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / ".lock").open("a+") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                stream.seek(0)
                owner = stream.read().strip() or "another process"
                raise UserError(f"{self.path}: is being written by {owner}; wait for it or stop it") from None
            stream.truncate(0)
            stream.write(f"process {os.getpid()}")
            stream.flush()
            self._remove_left_behind()
            yield

    def _remove_left_behind(self) -> None:
        """Remove what a killed writer left under a temporary name (see `atomic_path`); needs the lock."""
        for path in self.path.rglob(".*.tmp*"):
            if path.is_file() and _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)
