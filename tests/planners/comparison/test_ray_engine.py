"""The engine `ray`: the same results on two nodes, one of which dies on the way."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nesy.run_folder import RunFolder
from planners.comparison.compare import compare
from tests.planners.comparison.test_engines import LEARNERS, rows

pytestmark = pytest.mark.ray
SLOWER = replace(LEARNERS, dqn=replace(LEARNERS.dqn, episodes=250), seeds=(0, 1))


@pytest.fixture(autouse=True)
def _no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planners.comparison.compare.map_optimum", lambda *_: None)


def soon(holds: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Whether something comes true within the time that a busy machine may need."""
    until = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > until:
            return False
        time.sleep(0.1)
    return True


def test_two_nodes_one_of_which_is_killed(tiny_run: Path, tmp_path: Path) -> None:
    ray: Any = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    alone, clustered = RunFolder(tmp_path / "alone"), RunFolder(tmp_path / "clustered")
    for run in (alone, clustered):
        run.path.mkdir()
        run.world_model.symlink_to((tiny_run / "world_model").resolve())
    compare(alone, SLOWER, jobs=1)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        doomed = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False, logging_level="error")

        class Watching:
            """Progress that kills the second node once every core of the cluster, its own too, has a cell."""

            done, killed, killer = 0, False, None

            def task(self, description: str, total: int) -> Any:
                import contextlib

                return contextlib.nullcontext(self)

            def advance(self, steps: int = 1, **metrics: float) -> None:
                self.done += steps
                if self.killer is None:
                    self.killer = threading.Thread(target=self.kill)
                    self.killer.start()

            def kill(self) -> None:
                assert soon(lambda: ray.available_resources().get("CPU", 0) == 0)
                cluster.remove_node(doomed, allow_graceful=False)
                self.killed = True

        watching = Watching()
        compare(clustered, SLOWER, engine="ray", progress=watching)
        assert watching.killer is not None
        watching.killer.join()
        assert watching.killed
        assert soon(lambda: sum(node["Alive"] for node in ray.nodes()) == 1)  # Ray may notice late: cells were done
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert rows(alone) == rows(clustered)
    for path in alone.policies.glob("*.safetensors"):
        assert path.read_bytes() == (clustered.policies / path.name).read_bytes()
