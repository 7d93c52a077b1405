"""Sections of the report, in the order in which the page shows them.

A section is a module with ANCHOR, TITLE and `make(run, summary) -> HTML`, made from the run folder alone.
"""

from types import ModuleType

from nesy.report.sections import (
    belief,
    comparison,
    dbn,
    fidelity,
    graph,
    learning,
    provenance,
    replays,
    semantics,
    world_model,
)

SECTIONS: tuple[ModuleType, ...] = (
    comparison,
    learning,
    replays,
    belief,
    world_model,
    semantics,
    graph,
    dbn,
    fidelity,
    provenance,
)
