"""The world model's encoder, decoder and one transition, and perspective shifts; beside one at a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nesy.cli.benches.measuring import Row, Settings, ranked, rate

if TYPE_CHECKING:
    from nesy.world_model import SymbolicCodec, WorldModel

NEEDS: tuple[str, ...] = ("train",)
OBSERVATIONS = 100_000
CHUNK = 5000
"""Observations in one batch of the network."""


def measure(settings: Settings) -> list[Row]:
    """Observations per second through each part of the run's model, and shifts per second.

    The peer of the network is itself, asked one observation at a time; the `paper` architecture, untrained,
    stands beside it. On a GPU, if there is one, real time counts, copies to it and back included.
    """
    import torch

    from nesy.log.experience import load_columns
    from nesy.world_model import PaperWorldModel, SymbolicCodec, load_world_model

    torch.set_num_threads(1)
    columns = load_columns(settings.run.experience, ("view", "configuration"))
    rng = np.random.default_rng(settings.seed)
    rows = rng.integers(0, len(columns["view"]), OBSERVATIONS)
    views = np.ascontiguousarray(columns["view"][rows])
    model = load_world_model(settings.run.world_model)
    codec = SymbolicCodec(model)
    codes, actions = codec.codes(views), rng.integers(0, model.num_actions, OBSERVATIONS)
    found = _network(model, f"{model.architecture}", views, codes, actions, settings.seconds)
    if model.architecture != "paper":
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            other = PaperWorldModel(view_size=model.view_size).eval()
        found += _network(other, "paper, untrained", views, codes, actions, settings.seconds)
    found += _codec(codec, views, codes, actions, settings.seconds)
    return found + _shifts(codec, views, columns["configuration"][rows].astype(np.int64), settings)


def _network(
    model: WorldModel, name: str, views: np.ndarray, codes: np.ndarray, actions: np.ndarray, seconds: float
) -> list[Row]:
    """Encoding, decoding and transition by the network, with nothing remembered."""
    import torch

    certain = np.eye(model.num_values, dtype=np.float32)

    def work(part: str, device: str, batch: int, count: int) -> Callable[[], int]:
        def run() -> int:
            with torch.no_grad():
                for first in range(0, count, batch):
                    rows = slice(first, first + batch)
                    if part == "encoding":
                        model.codes(torch.as_tensor(views[rows], device=device)).cpu().numpy()
                        continue
                    belief = torch.as_tensor(certain[codes[rows]], device=device)
                    if part == "decoding":
                        model.decode(belief).argmax(-1).cpu().numpy()
                    else:
                        model.transition(belief, torch.as_tensor(actions[rows], device=device)).cpu().numpy()
            return count

        return run

    found: list[Row] = []
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    for part in ("encoding", "decoding", "transition"):
        alone = f"{part}, {name}, one at a time"
        rates = {alone: rate(work(part, "cpu", 1, 100), seconds)}
        for device in devices:
            model.to(device)
            clock = time.perf_counter if device == "cuda" else time.process_time
            label = f"{part}, {name}, {OBSERVATIONS:,} on {device}"
            rates[label] = rate(work(part, device, CHUNK, OBSERVATIONS), seconds, clock=clock)
        model.to("cpu")
        found += ranked("obs/s", alone, rates)
    return found


def _codec(
    codec: SymbolicCodec, views: np.ndarray, codes: np.ndarray, actions: np.ndarray, seconds: float
) -> list[Row]:
    """The codec, which asks the network once per distinct view or code; beside the network without memory."""
    import torch

    from nesy.world_model import SymbolicCodec

    certain = codec.certain(codes)

    def fresh() -> int:
        SymbolicCodec(codec.model).codes(views)
        return len(views)

    def known() -> int:
        codec.codes(views)
        return len(views)

    def plain() -> int:
        with torch.no_grad():
            for first in range(0, len(views), CHUNK):
                codec.model.codes(torch.as_tensor(views[first : first + CHUNK])).numpy()
        return len(views)

    def decode() -> int:
        codec.views(codes)
        return len(codes)

    def predict() -> int:
        codec.predict(certain, actions)
        return len(certain)

    peer = "encoding, no codec"
    return ranked(
        "obs/s",
        peer,
        {
            peer: rate(plain, seconds),
            "encoding, codec, nothing known": rate(fresh, seconds),
            "encoding, codec, all known": rate(known, seconds),
            "decoding, codec, all known": rate(decode, seconds),
            "transition, codec, distinct pairs asked": rate(predict, seconds),
        },
    )


def _shifts(codec: SymbolicCodec, views: np.ndarray, configurations: np.ndarray, settings: Settings) -> list[Row]:
    """Perspective shifts: the published way one at a time, all pairs of the code book afresh, and from memory."""
    from nesy.perspective.operator import PerspectiveShift, imagine
    from nesy.world_model import SymbolicCodec

    planner = "network" if codec.packed() is None else "table"
    seen = np.flatnonzero(configurations > 0)
    if not len(seen):
        return []
    codes = np.unique(codec.codes(views), axis=0)
    beliefs = codec.beliefs(views[seen])
    everywhere = 4 * codec.view_size**2

    def alone() -> int:
        for row in range(20):
            imagine(beliefs[row % len(beliefs)], int(configurations[seen[row % len(seen)]]), codec, planner="network")
        return 20

    def cold() -> int:
        other = SymbolicCodec(codec.model)
        other.packed()
        return PerspectiveShift(other, planner).prepare(codes)

    def fresh() -> int:
        return PerspectiveShift(codec, planner).prepare(codes)

    warm = PerspectiveShift(codec, planner)

    def remembered() -> int:
        warm(beliefs, configurations[seen])
        return len(beliefs)

    pairs = f"{len(codes)} x {everywhere} pairs"
    peer = "shift, network, one at a time"
    return ranked(
        "shifts/s",
        peer,
        {
            peer: rate(alone, settings.seconds),
            f"shift, {planner}, fresh, {pairs}": rate(cold, settings.seconds),
            f"shift, {planner}, fresh, codes decoded before, {pairs}": rate(fresh, settings.seconds),
            f"shift, {planner}, from memory, {len(beliefs):,} moments": rate(remembered, settings.seconds),
        },
    )
