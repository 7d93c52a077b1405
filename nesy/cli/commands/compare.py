"""Compare DQN, POMDP planners and references on the same maps: return, success, time per decision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import tyro

from nesy.cli import pipeline, tables
from nesy.run_folder import RunFolder, read_json
from planners.config import LEARNERS, CompareConfig, LearnerName


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy compare`."""

    engine: Literal["local", "ray"] = "local"
    """Where the grid runs: processes of this machine (--jobs), or a Ray cluster."""
    address: str | None = None
    """Address of the Ray cluster; by default the one that Ray finds, or one on this machine alone."""
    learner: LearnerName | None = None
    """Settings of the DQN to start from: fast (learns best per second), paper (those of the paper: one environment, an
    update per step, twenty minutes a training), published (and all in which the published code differs from the text);
    by default those of the run."""
    settings: Annotated[CompareConfig, tyro.conf.arg(name="")] = CompareConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    settings = pipeline.base_config(arguments).compare
    learner = pipeline.option(arguments, "--learner")
    if learner in LEARNERS:
        settings = replace(settings, dqn=LEARNERS[learner](settings.dqn.episodes))
    return Arguments(settings=settings)


def run(options: Arguments) -> dict[str, Any]:
    """Run the cells of the grid that the run folder does not hold yet."""
    if options.settings.rules:
        check_rules(options)
    with pipeline.opened(options, "compare", compare=options.settings) as steps:
        result = steps.compare(options.engine, options.address)
        result["left_out"] = steps.left_out()
        path = steps.run.results / "influence_rules.json"
        return result | ({"influence_rules": read_json(path)} if path.is_file() else {})


def check_rules(options: Arguments) -> None:
    """Ground the rule files on the run's codes before they become part of its configuration.

    Raises:
        UserError: a rule is wrong; the run has no world model yet.
    """
    from domains.core import load_domain
    from planners.comparison.model_store import ModelStore
    from planners.comparison.players import action_mask

    run = RunFolder.open(options.run)
    run.require("collect", "train", "extract")
    domain = load_domain(pipeline.config_of(options).domain)
    action_mask(options.settings, ModelStore(run).codec, domain)


def show(result: dict[str, Any]) -> None:
    """Print the comparison table, what was left out, and what rules about the person changed."""
    tables.print_comparison(result["comparison"])
    tables.print_left_out(result["left_out"])
    for variant, change in result.get("influence_rules", {}).items():
        if change is not None:
            share = f"{change['constrained']} of {change['codes']} known codes"
            chance = f"{change['removed']:.2g} on average, {change['most']:.2g} at most"
            print(f"{variant}: rules about the person exclude moves for {share}; these had a probability of {chance}")
