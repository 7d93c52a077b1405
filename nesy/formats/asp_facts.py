"""ASP facts for clingo: structure, rows and counts of the 2DBN in the vocabulary of nesy.asp."""

from __future__ import annotations

from pathlib import Path

from nesy.asp.program import names
from nesy.asp.program.facts import SCALE, Facts
from nesy.dbn.model import TwoSliceDBN
from nesy.names import remarks
from nesy.run_folder import atomic_path

NAMES = names
"""Names of actions, as terms."""
GROUPS = ("factor", "value", "action", "scale", "parent", "arity", "row", "likely", "met", "dropped")


def write(dbn: TwoSliceDBN, path: Path) -> None:
    """Write `dbn` to the file `path`, rows never met in experience included."""
    facts = Facts(dbn, None, all_rows=True)
    lines = [f"% {name}: {text}" for name, text in facts.vocabulary().items() if name.split("(")[0] in GROUPS]
    lines += remarks(((str(i), name) for i, name in enumerate(dbn.factor_names)), "% factor")
    head = (
        f"% 2DBN of {dbn.num_factors} factors x {dbn.num_values} values; weights are parts of {SCALE}.\n"
        f"% Largest probability that the weights leave out of a row: {facts.dropped():.3g}\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(head + "\n".join(lines) + "\n\n" + facts.text(GROUPS), encoding="utf-8")
