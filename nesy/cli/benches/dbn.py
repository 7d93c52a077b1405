"""The 2DBN: one-step inference beside pyAgrum's, filtering, large files, parents recovered.

Figures of the run's own model stand beside those of random models of the same size with fewer parents: dense tables
of five parents with arcs inside slice t+1 are what exact inference is slow on.
"""

from __future__ import annotations

import importlib.util
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from nesy.cli.benches.measuring import Row, Settings, rate

NEEDS: tuple[str, ...] = ("extract",)
BATCH = 64
STEPS = 6
"""Steps after which the beliefs of a filter are taken as those in use."""


def measure(settings: Settings) -> list[Row]:
    """All of it; pyAgrum is the peer of one-step inference where it is installed (the `check` extra)."""
    from nesy.dbn import TwoSliceDBN

    rng = np.random.default_rng(settings.seed)
    models = {"8 factors x 8 values, 2 parents": _random(rng, 2), "8 x 8, 3 parents": _random(rng, 3)}
    models["the run's model"] = TwoSliceDBN.load(settings.run.dbn)
    rows: list[Row] = []
    for name, dbn in models.items():
        rows += _one_step(dbn, name, settings, rng)
    for name, dbn in models.items():
        rows += _filtering(dbn, name, settings, rng)
    return rows + _large_files(rng) + _recovered(settings)


def _random(rng: np.random.Generator, parents: int) -> Any:
    from nesy.dbn.evaluation.recovery import random_model

    return random_model(rng, parents=parents, actions=4)


def _codes(dbn: Any, rng: np.random.Generator, number: int) -> np.ndarray:
    known = dbn.tables.get("codes")
    if known is not None:
        return np.asarray(known[rng.integers(len(known), size=number)], dtype=np.int64)
    return rng.integers(dbn.num_values, size=(number, dbn.num_factors))


def _one_step(dbn: Any, name: str, settings: Settings, rng: np.random.Generator) -> list[Row]:
    """Exact marginals after one step from certain codes; pyAgrum gets the same network of one action."""
    from nesy.dbn.inference.factored import FactoredUpdates

    codes = _codes(dbn, rng, BATCH)
    action = min(2, dbn.num_actions - 1)
    updates, actions = FactoredUpdates(dbn), np.full(BATCH, action)
    beliefs = np.eye(dbn.num_values)[codes]

    def ours() -> int:
        updates.predict(beliefs, actions)
        return BATCH

    what = f"one step exactly from a code, {name}"
    mine = rate(ours, settings.seconds)
    if importlib.util.find_spec("pyagrum") is None:
        return [Row(what, mine, "steps/s", what, 1.0)]
    engine, ask = _pyagrum(dbn, action)
    place = iter(range(10**9))

    def theirs() -> int:
        code = codes[next(place) % BATCH]
        engine.setEvidence({f"x{i}_0": int(v) for i, v in enumerate(code)})
        engine.makeInference()
        for variable in ask:
            engine.posterior(variable).tolist()
        return 1

    peer = f"pyAgrum, lazy propagation, {name}"
    other = rate(theirs, settings.seconds)
    return [Row(peer, other, "steps/s", peer, 1.0), Row(what, mine, "steps/s", peer, mine / other)]


def _pyagrum(dbn: Any, action: int) -> tuple[Any, list[str]]:
    gum = importlib.import_module("pyagrum")
    network = gum.BayesNet("step")
    k, n = dbn.num_values, dbn.num_factors
    for i in range(n):
        network.add(gum.RangeVariable(f"x{i}_0", "", 0, k - 1))
        network.cpt(f"x{i}_0").fillWith([1 / k] * k)
    for i in dbn.order:
        network.add(gum.RangeVariable(f"x{i}_1", "", 0, k - 1))
        parents = dbn.parents(action, i)
        for where, p in parents:
            network.addArc(f"x{p}_{where}", f"x{i}_1")
        axes = (*range(len(parents) - 1, -1, -1), len(parents))
        network.cpt(f"x{i}_1").fillWith(dbn.tensor(action, i).transpose(axes).reshape(-1).tolist())
    return gum.LazyPropagation(network), [f"x{i}_1" for i in range(n)]


def _filtering(dbn: Any, name: str, settings: Settings, rng: np.random.Generator) -> list[Row]:
    """Batched exact belief updates: prediction, likelihood, normalisation.

    From certain beliefs; from those of a filter that sees half of the factors at every step; from beliefs spread over
    all values of all factors.
    """
    from nesy.dbn.inference.factored import FactoredUpdates

    n, k = dbn.num_factors, dbn.num_values
    updates = FactoredUpdates(dbn)
    likelihoods = rng.random((BATCH, n, k)) ** 4
    actions = rng.integers(dbn.num_actions, size=BATCH)
    codes = _codes(dbn, rng, BATCH)
    starts = {"certain": np.eye(k)[codes], "in use": np.eye(k)[codes]}
    for _ in range(STEPS):
        taken = rng.integers(dbn.num_actions, size=BATCH)
        codes = dbn.sample(codes, taken, rng).astype(np.int64)
        seen = np.where(rng.random((BATCH, n, 1)) < 0.5, np.eye(k)[codes], 1.0)
        starts["in use"] = updates.filter(starts["in use"], taken, seen)
    starts["spread"] = rng.dirichlet(np.full(k, 0.5), size=(BATCH, n))
    rows = []
    for start, beliefs in starts.items():

        def work(beliefs: np.ndarray = beliefs) -> int:
            updates.filter(beliefs, actions, likelihoods)
            return BATCH

        figure = rate(work, settings.seconds)
        what = f"filtering, {start} beliefs, {name}"
        rows.append(Row(what, figure, "updates/s", "100,000 updates/s", figure / 1e5))
    return rows


def _large_files(rng: np.random.Generator) -> list[Row]:
    """A model of 20 factors x 16 values with 3 parents, written and read back; the peer is the limit of 10 s."""
    from nesy import formats
    from nesy.dbn.evaluation.recovery import random_model

    dbn = random_model(rng, factors=20, values=16, parents=3)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in ("native", "parquet", "jgum"):
            path = Path(folder) / f"m{formats.FORMATS[name].suffix}"
            started = time.process_time()
            formats.export(dbn, path, format=name)
            formats.read(path, format=name)
            spent = time.process_time() - started
            rows.append(Row(f"{name}: 20 x 16, 3 parents, written and read", spent, "s", "10 s", 10 / spent))
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return [*rows, Row("most memory of this process so far", most, "GB", "2 GB", 2 / most)]


def _recovered(settings: Settings) -> list[Row]:
    """Parents of random models of 8 x 8 with 2 parents from 20,000 transitions; the peer is the wanted 0.98."""
    from nesy.dbn.evaluation.recovery import recover

    found = recover(range(settings.seed, settings.seed + 5))
    return [
        Row("parents recovered, 5 models, precision", found.precision, "", "0.98", found.precision / 0.98),
        Row("parents recovered, 5 models, recall", found.recall, "", "0.98", found.recall / 0.98),
    ]
