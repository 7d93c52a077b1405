"""A model extracted from a world model trained on the real domain: small, made once per process."""

import functools
import tempfile
from pathlib import Path

from nesy.config import CollectConfig, TrainConfig
from nesy.run_folder import RunFolder, write_json


@functools.cache
def extracted_run():
    """A run folder with little experience, a world model trained for one epoch, and its 2DBN."""
    from domains.core import load_domain
    from nesy.dbn.learning.extraction import extract_run
    from nesy.log.collection import collect
    from nesy.log.experience import Experience
    from nesy.world_model import train

    folder = tempfile.TemporaryDirectory()
    run = RunFolder(Path(folder.name) / "run")
    settings = CollectConfig(crossing_episodes=60, following_episodes=10, shard_episodes=50)
    collect(load_domain(), settings, run.experience, variant="paper", seed=0)
    config = TrainConfig(epochs=1, time_limit=0.0, held_out=0.0, max_parents=2)
    train(Experience.load(run.experience), config, run.world_model, seed=0)
    write_json(run.config, {"seed": 0})
    figures = extract_run(run, "person_following")
    return folder, run, figures
