"""The main job: collect, train, extract, compare, report. Goes on where it stopped when called again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nesy.cli import pipeline, tables
from nesy.config import CollectConfig, ExtractConfig, TrainConfig
from planners.config import CompareConfig


@dataclass(frozen=True)
class Arguments(pipeline.CommonArguments):
    """Options of `nesy run`."""

    collect: CollectConfig = CollectConfig()
    train: TrainConfig = TrainConfig()
    extract: ExtractConfig = ExtractConfig()
    compare: CompareConfig = CompareConfig()


def defaults(arguments: list[str]) -> Arguments:
    """The options' values where the command line says nothing."""
    base = pipeline.base_config(arguments)
    return Arguments(collect=base.collect, train=base.train, extract=base.extract, compare=base.compare)


def run(options: Arguments) -> dict[str, Any]:
    """Run every step that the folder does not hold yet; returns the summary."""
    sections = {step: getattr(options, step) for step in ("collect", "train", "extract", "compare")}
    with pipeline.opened(options, "collect", **sections) as steps:
        for step in (steps.collect, steps.train, steps.extract, steps.compare, steps.report):
            step()
        return {**steps.run.read_summary(), "left_out": steps.left_out(), "report": str(steps.run.report)}


def show(result: dict[str, Any]) -> None:
    """Print the comparison table and where the report is."""
    tables.print_comparison(result["comparison"])
    tables.print_left_out(result["left_out"])
    seconds = ", ".join(f"{step} {value:.0f} s" for step, value in result["timing"].items())
    print(f"time: {seconds}")
    print(f"report: {result['report']}")
