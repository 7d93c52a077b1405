"""Cells of a comparison on a Ray cluster: the same code, the same results.

Nothing is shared between the machines but Ray: the parts of the run folder that cells read travel once as bytes
through Ray's object store, every worker unpacks them into a folder of its own, and what a cell leaves comes back as
bytes and is written by the driver, one cell at a time as they finish. A cell whose worker or node dies is run again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from domains.core import DomainError
from nesy.errors import UserError
from nesy.progress import Task
from nesy.run_folder import RunFolder, atomic_path
from planners.comparison.engines.jobs import ATTEMPTS, CellJob, Tally, give_up, run_job

Files = dict[str, bytes]
"""Contents by path relative to the run folder."""
SHIPPED = ("world_model", "dbn", "ialm")
LEFT = ("results/cells", "policies")
POLL = 0.5
"""Seconds between two looks at what the cluster reports."""


def run_on_ray(jobs_of: list[CellJob], task: Task, address: str | None = None) -> None:
    """Run cells on the cluster at `address`, or on one of this machine's cores.

    Raises:
        UserError: Ray is not installed, the cluster is out of reach, or workers keep dying on one cell.
    """
    ray = _ray()
    with _connected(ray, address):
        Counter = ray.remote(num_cpus=0)(_Counter)
        # On the driver's node, so that it lives as long as anybody listens.
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=False
        )
        counter = Counter.options(scheduling_strategy=here).remote()
        remote = ray.remote(num_cpus=1, max_retries=0)(_run_there)
        files = ray.put(_packed(jobs_of[0][1]))
        tally = Tally(task)
        running: dict[Any, CellJob] = {}
        attempts = dict.fromkeys((job[0].name for job in jobs_of), 0)

        def begin(job: CellJob) -> None:
            attempts[job[0].name] += 1
            if attempts[job[0].name] > ATTEMPTS:
                raise give_up(job[0].name, "look at the cluster's logs")
            cell, _, config, seed, domain_name = job
            rules = {str(path): Path(path).read_text(encoding="utf-8") for path in config.rules}
            policy = Path(cell.policy).read_bytes() if cell.policy else None
            running[remote.remote(files, (cell, config, seed, domain_name), rules, policy, counter)] = job

        for job in jobs_of:
            begin(job)
        while running:
            done, _ = ray.wait(list(running), timeout=POLL)
            for name, count in ray.get(counter.counts.remote()).items():
                tally.report(name, count)
            for reference in done:
                job = running.pop(reference)
                try:
                    left = ray.get(reference)
                except ray.exceptions.RayTaskError as error:  # the cell itself went wrong
                    cause = error.as_instanceof_cause()
                    ours = next((kind for kind in (UserError, DomainError) if isinstance(cause, kind)), None)
                    raise (cause if ours is None else ours(str(error.cause))) from None
                except ray.exceptions.RayError:  # its worker or node is gone
                    begin(job)
                    continue
                _unpack(left, job[1])


class _Counter:
    """How many episodes every cell has done, kept on the driver's node."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def add(self, name: str, done: int) -> None:
        """The cell has done so many in its present attempt."""
        self._counts[name] = done

    def counts(self) -> dict[str, int]:
        """All of them."""
        return self._counts


def _run_there(files: Files, job: tuple[Any, ...], rules: dict[str, str], policy: bytes | None, counter: Any) -> Files:
    """One cell on a worker: unpack what it needs, run it, and hand back what it left."""
    from dataclasses import replace

    cell, config, seed, domain_name = job
    with tempfile.TemporaryDirectory(prefix="nesy-") as name:
        folder = Path(name)
        _unpack(files, folder)
        moved = []
        for number, text in enumerate(rules.values()):
            moved.append(str(folder / f"rules-{number}.lp"))
            Path(moved[-1]).write_text(text, encoding="utf-8")
        if policy is not None:
            (folder / "policy.safetensors").write_bytes(policy)
        done = 0

        def advance(count: int = 1, **_: float) -> None:
            nonlocal done
            done += count
            counter.add.remote(cell.name, done)

        there = replace(cell, policy=str(folder / "policy.safetensors")) if policy is not None else cell
        run_job((there, folder, replace(config, rules=tuple(moved)), seed, domain_name), advance)
        return {
            str(path.relative_to(folder)): path.read_bytes()
            for part in LEFT
            for path in sorted((folder / part).glob("[!.]*"))
        }


def _packed(folder: Path) -> Files:
    """The parts of a run folder that cells read."""
    run = RunFolder(folder)
    return {
        str(path.relative_to(run.path)): path.read_bytes()
        for part in SHIPPED
        for path in sorted((run.path / part).rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def _unpack(files: Files, folder: Path) -> None:
    for name, content in files.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(content)


@contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    """A connection to the cluster; one that was there before stays."""
    if ray.is_initialized():
        yield
        return
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error", include_dashboard=False)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"--address {address}: no Ray cluster to be reached there ({reason})") from None
    try:
        yield
    finally:
        ray.shutdown()


def _ray() -> Any:
    try:
        import ray
        import ray.exceptions
        import ray.util.scheduling_strategies
    except ImportError:
        raise UserError(
            "--engine ray needs Ray, which is not installed; install it with: pip install 'nesy[ray]'"
        ) from None
    return ray
