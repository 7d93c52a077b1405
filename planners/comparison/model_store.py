"""The learned models of a run, in one place: world model, 2DBN, and the local models that planners learn per variant.

Local models lie in ialm/, those of further variants in folders of their own in there; the experience of following
that they are learned from besides the run's own lies in `practice/` beside them, hand-structured models in
`structured/`.
"""

from __future__ import annotations

import shutil
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from domains.core import ACTION_NAMES, Domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, read_json, write_json
from planners.config import SearchConfig

if TYPE_CHECKING:
    from nesy.dbn import TwoSliceDBN
    from nesy.log.experience import Experience
    from nesy.world_model import SymbolicCodec
    from planners.person_following.ialm import IALM
    from planners.person_following.structured.drawn_maps.mapped_model import MappedModel
    from planners.person_following.structured.known_maps.minds import MindModel

TABLES_VERSION = 3
"""Of the local model (planners.person_following.ialm_learning)."""
STRUCTURED_VERSION = 3
"""Of the hand-structured models (planners.person_following.structured)."""
KNOWN_MAPS, DRAWN_MAPS = "known-maps", "drawn-maps"


class NoModel(UserError):
    """What an agent plans with does not exist for a variant."""


class ModelStore:
    """Reads the learned models of a run, and learns those that planners need."""

    def __init__(self, run: RunFolder) -> None:
        self.run = run

    @cached_property
    def codec(self) -> SymbolicCodec:
        """What turns views into codes, by the run's world model."""
        from nesy.world_model import SymbolicCodec, load_world_model

        return SymbolicCodec(load_world_model(self.run.world_model))

    @cached_property
    def dbn(self) -> TwoSliceDBN:
        """The extracted 2DBN."""
        from nesy.dbn import TwoSliceDBN

        return TwoSliceDBN.load(self.run.dbn)

    def folder(self, variant: str) -> Path:
        """Where the local models of a variant are: ialm/, and for further variants a folder of its own in there."""
        path = self.run.ialm / "model.json"
        first = read_json(path).get("provenance", {}).get("variant", variant) if path.is_file() else variant
        return self.run.ialm if first == variant else self.run.ialm / variant

    def local_model(self, variant: str) -> IALM:
        """The influence-augmented local model of a variant, over the run's 2DBN."""
        from planners.person_following.ialm import IALM

        return IALM.load(self.folder(variant), self.dbn)

    def structured_model(self, variant: str) -> MindModel | MappedModel:
        """The hand-structured model of a variant.

        Raises:
            NoModel: the variant is of a kind that none was written for.
        """
        from planners.person_following.structured.drawn_maps.mapped_model import MappedModel
        from planners.person_following.structured.known_maps.minds import MindModel

        folder = self.folder(variant) / "structured"
        kind = read_json(folder / "kind.json")["kind"]
        if kind is None:
            raise NoModel("no hand-structured model: one goal per map, and nothing hidden by walls")
        return MindModel.load(folder) if kind == KNOWN_MAPS else MappedModel.load(folder)

    def practice_steps(self, variant: str, config: SearchConfig) -> int:
        """Environment steps of the practice that the local models of a variant were learned from."""
        import pyarrow.parquet as pq

        shards = (self.folder(variant) / "practice").glob("part-*.parquet")
        rows = sum(pq.read_metadata(path).num_rows for path in shards)
        return min(rows, config.practice_steps or rows)

    def learn(
        self,
        domain: Domain,
        variant: str,
        config: SearchConfig,
        seed: int,
        structured: bool = False,
        progress: Progress = SILENT,
    ) -> None:
        """Learn the local models of a variant from the run's experience and practice, unless the run holds them.

        Args:
            domain: plays the practice.
            variant: of the task.
            config: how much practice, and the discount.
            seed: of the practice.
            structured: learn the hand-structured model too.
            progress: told of collected episodes.

        Raises:
            NoModel: the world has no person, or one that is never in view.
            UserError: the practice has fewer steps than are to be learned from.
        """
        name = domain.spec.name
        if not domain.spec.has_person:
            raise NoModel(f"world '{name}' has no person, and this agent plans with a model of one")
        if domain.spec.action_names != ACTION_NAMES:
            raise NoModel(
                f"world '{name}' has other actions than {', '.join(ACTION_NAMES)}, which this agent plans with"
            )
        config = config.at(domain.spec.discount(variant))
        collected = {
            "variant": variant,
            "seed": seed,
            "practice_episodes": config.practice_episodes,
            "practice_mixture": config.practice_mixture,
        }
        learned_from = {**collected, "practice_steps": config.practice_steps}
        tables = {**learned_from, "discount": config.per_step, "tables": TABLES_VERSION}
        scenes = {**learned_from, "discount": config.per_step, "structured": STRUCTURED_VERSION}
        home = self.folder(variant)
        before = _provenance(home / "model.json")
        wanted = before != tables, structured and _provenance(home / "structured" / "kind.json") != scenes
        if not any(wanted):
            return
        from nesy.log.experience import Experience
        from planners.person_following.ialm_learning import joined, learn_ialm

        experience = Experience.load(self.run.experience)
        if not (experience.configuration > 0).any():
            raise NoModel(
                f"in the experience of world '{name}' nobody is ever in view: there is no person to plan with"
            )
        here = [experience] if self._own_variant() in (None, variant) else []
        if config.practice_episodes:
            stale = before is not None and any(before.get(name) != value for name, value in collected.items())
            practice = _practice(domain, variant, config, home / "practice", seed, stale, progress)
            here = [joined(here[0], practice) if here else practice]
            experience = joined(experience, practice)
        if wanted[1]:
            self._learn_structured(here[0] if here else None, scenes, home / "structured")
        if wanted[0]:
            learn_ialm(self.dbn, self.codec, experience, tables, config.per_step).save(home)

    def _learn_structured(self, experience: Experience | None, provenance: dict[str, Any], folder: Path) -> None:
        """The model of the kind that the experience asks for; which one that is stands in `kind.json`, written last."""
        from planners.person_following.structured.drawn_maps.mapped_learning import learn_mapped, walls_hide
        from planners.person_following.structured.known_maps.mind_learning import learn_minds, several_goals

        kind = None
        if experience is not None and several_goals(experience):
            kind = KNOWN_MAPS
            learn_minds(self.codec, experience, provenance).save(folder)
        elif experience is not None and walls_hide(experience):
            kind = DRAWN_MAPS
            learn_mapped(experience, float(provenance["discount"]), provenance).save(folder)
        write_json(folder / "kind.json", {"kind": kind, "provenance": provenance})

    def _own_variant(self) -> str | None:
        """The variant that the run's own experience is of; None where the run does not say."""
        return str(read_json(self.run.config)["variant"]) if self.run.config.is_file() else None


def _provenance(path: Path) -> dict[str, Any] | None:
    """What a stored model was learned from; None where there is none."""
    return dict(read_json(path).get("provenance", {})) if path.is_file() else None


def _practice(
    domain: Domain, variant: str, config: SearchConfig, folder: Path, seed: int, stale: bool, progress: Progress
) -> Experience:
    """As many steps of following as are to be learned from, episode after episode, collected where they are missing."""
    from nesy.log.collection import collect_following
    from nesy.log.experience import Experience

    if stale:
        shutil.rmtree(folder, ignore_errors=True)
    collect_following(
        domain, config.practice_episodes, config.practice_mixture, folder, seed, progress, variant=variant
    )
    practice = Experience.load(folder)
    if not config.practice_steps:
        return practice
    if len(practice) < config.practice_steps:
        raise UserError(
            f"the practice has {len(practice):,} steps, fewer than the {config.practice_steps:,} to learn from; "
            "raise --search.practice-episodes, or lower --learning-steps"
        )
    return practice.select(np.lexsort((practice.t, practice.episode))[: config.practice_steps])
