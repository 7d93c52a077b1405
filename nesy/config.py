"""Settings of the steps that make a symbolic model: plain dataclasses, cheap to import.

Every field's docstring is its help text on the command line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import tyro

from nesy.errors import UserError


def check_ranges(config: Any, section: str, **intervals: str) -> None:
    """Refuse settings outside their intervals, written as in mathematics: `[0, 1)`, `(0, inf)`.

    Args:
        config: holds the settings, numbers or tuples of numbers, or None for what is left open.
        section: of the configuration, for the message.
        intervals: for each setting.

    Raises:
        UserError: a number lies outside, or is none.
    """
    for name, interval in intervals.items():
        if getattr(config, name) is None:
            continue
        low, high = (float(bound) for bound in interval[1:-1].split(","))
        setting = getattr(config, name)
        for value in setting if isinstance(setting, tuple) else (setting,):
            above = value > low or (interval[0] == "[" and value == low)
            below = value < high or (interval[-1] == "]" and value == high)
            if not (above and below):
                raise UserError(f"{section}: {name} must be {_in_words(interval, low, high)}, not {value}")


def _in_words(interval: str, low: float, high: float) -> str:
    if high < float("inf"):
        return f"in {interval}"
    return f"{'at least' if interval[0] == '[' else 'above'} {low:g}"


@dataclass(frozen=True)
class CollectConfig:
    """What experience to collect."""

    crossing_episodes: int = 3000
    """Episodes on the crossing task, half of them random and half by the A* expert."""
    following_episodes: int = 3000
    """Episodes of person following, for what is to be learned about the person and the rewards."""
    following_mixture: float = 0.5
    """Probability that the switching behaviour of the following episodes takes a random action."""
    num_envs: int = 256
    """Environments stepped at once."""
    shard_episodes: int = 1000
    """Episodes in one Parquet file: the unit in which collection is resumed."""

    def __post_init__(self) -> None:
        """Check every number."""
        counts = dict.fromkeys(("crossing_episodes", "following_episodes"), "[0, inf)")
        sizes = dict.fromkeys(("num_envs", "shard_episodes"), "[1, inf)")
        check_ranges(self, "collect", **counts, **sizes, following_mixture="[0, 1]")
        if not self.crossing_episodes + self.following_episodes:
            raise UserError("collect: no episodes to collect; set crossing_episodes or following_episodes")


@dataclass(frozen=True)
class TrainConfig:
    """How the world model is trained."""

    architecture: Literal["symbolic", "paper"] = "symbolic"
    """`symbolic`: made so that the extracted table loses nothing; `paper`: as published."""
    epochs: int = 60
    """Passes over the data, as an upper limit: training stops early once every gate holds."""
    batch_size: int = 500
    """Transitions in one mini-batch."""
    learning_rate: float = 1e-2
    """Adam's step size at the start."""
    learning_rate_decay: float = 0.9
    """Factor on the step size after every epoch."""
    temperature: float = 0.6
    """Gumbel-softmax temperature (annealed by the `symbolic` architecture)."""
    kl_weight: float = 0.1
    """Weight of the KL to the uniform prior."""
    max_parents: int = 4
    """Most parents from slice t that a factor may have under one action."""
    intra_slice_arcs: bool = True
    """Whether earlier factors of slice t+1 may be parents too."""
    named_factors: int = 6
    """Factors (of 8) whose values answer questions about the view; the rest complete the code. More of them make
    codes easier to read and the next code harder to predict."""
    searches: int = 2
    """Code books searched at most: there is another one where the first predicts the next code too badly to pass."""
    headline: tuple[str, ...] = ("wall_ahead", "goal_visible", "opening_visible")
    """Predicates that the first named factor answers in any case, where the domain has them."""
    weighting: Literal["visits", "maps"] | None = None
    """What a transition counts as: `visits`, how often it was met, or `maps`, on how many maps. By default as the world
    declares (person following: maps), else visits."""
    mirror_images: Annotated[bool | None, tyro.conf.arg(constructor=bool)] = None
    """Whether every step also counts for its images under the symmetries that the world declares (person following:
    left and right exchanged). By default where it declares any."""
    held_out: float = 0.2
    """Share of the maps kept out of training for the gates."""
    time_limit: float = 180.0
    """Seconds after which training ends with the best model so far; 0 for no limit."""
    device: str = "cpu"
    """Where to train: `cpu`, `cuda`, `cuda:1`, ..."""

    def __post_init__(self) -> None:
        """Check every number."""
        sizes = dict.fromkeys(("epochs", "batch_size", "searches"), "[1, inf)")
        weights = dict.fromkeys(("kl_weight", "time_limit"), "[0, inf)")
        rates = {"learning_rate": "(0, inf)", "learning_rate_decay": "(0, 1]", "temperature": "(0, inf)"}
        whole = {"max_parents": "[1, 5]", "named_factors": "[0, 8]"}
        check_ranges(self, "train", **sizes, **weights, **rates, **whole, held_out="[0, 1)")
        if self.weighting not in (None, "visits", "maps"):
            raise UserError(f"train: weighting must be visits or maps, not {self.weighting!r}")

    def in_world(self, world: str, weighting: Literal["visits", "maps"], symmetric: bool) -> TrainConfig:
        """The settings with those filled in that are left to the world.

        Args:
            world: its name, for the message.
            weighting: what it declares.
            symmetric: whether it declares a symmetry.

        Raises:
            UserError: mirror images are asked for where no symmetry is declared.
        """
        if self.mirror_images and not symmetric:
            raise UserError(
                f"train: mirror_images: {world} declares no symmetry, so the image of a step may be none; leave it out "
                "or say --no-mirror-images (a domain declares what holds in it as `symmetries`)"
            )
        mirror_images = symmetric if self.mirror_images is None else self.mirror_images
        return replace(self, weighting=self.weighting or weighting, mirror_images=mirror_images)


@dataclass(frozen=True)
class ExtractConfig:
    """How the 2DBN is extracted."""

    source: Literal["network", "experience"] = "network"
    """What the tables are of: the trained network, or counts of the transitions met (in the network's codes)."""
    score: Literal["bdeu", "bic", "aic"] = "bdeu"
    """What parents are chosen by where the network does not say them: the `paper` architecture, or experience."""
    max_parents: int = 4
    """Most parents from slice t where they are chosen by score."""
    prior_count: float = 1.0
    """Transitions that the Dirichlet prior of a row counts as when rows are counted from experience."""

    def __post_init__(self) -> None:
        """Check every number."""
        check_ranges(self, "extract", max_parents="[1, 5]", prior_count="(0, inf)")
