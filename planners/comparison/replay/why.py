"""Why an agent chose an action in one situation: its values, the rules in force, and what it expected to happen.

view, configuration  ->  the agent's own percepts  ->  the values of all actions (the DQN's Q, or those that a
planner's search found)  ->  the chosen action, by how much it was ahead, and what forbids the others
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import Domain
from nesy.errors import UserError
from nesy.run_folder import RunFolder
from planners.agents import BeliefAgent, DQNAgent, Situation, says_something
from planners.comparison.evaluation import permitted
from planners.comparison.grid import Cell, grid
from planners.comparison.players import restored_player
from planners.config import CompareConfig
from planners.perception import Percepts
from planners.shielding import ShieldMask


@dataclass(frozen=True)
class Choice:
    """What an agent would do, and why."""

    agent: str
    """Name of the cell."""
    algorithm: str
    """What decided."""
    model: str
    """What it planned with."""
    action: str
    values: dict[str, float]
    """Expected discounted return of each action, as the agent sees it; of a planner only those that it tried."""
    visits: dict[str, int]
    """How often a planner tried each action; empty for a learner."""
    allowed: tuple[str, ...]
    """What the rules leave."""
    because: dict[str, tuple[str, ...]]
    """For each forbidden action the places of the rules that forbid it."""
    code: tuple[int, ...]
    """The robot's code."""
    shifted: tuple[int, ...] | None
    """The most probable value of each factor of what it takes the person to see; None where it does not know."""
    influence: dict[str, float]
    """I(u | l): how probably the person does what next, unless it waits; empty for a learner."""

    @property
    def text(self) -> str:
        """For people."""
        ranked = sorted(self.values, key=lambda name: -self.values[name])
        lines = [f"{self.agent} chooses '{self.action}' ({self.algorithm}; model: {self.model})"]
        for name in ranked:
            tried = f", tried {self.visits[name]} times" if self.visits else ""
            ruled = f", forbidden by {', '.join(self.because[name])}" if name in self.because else ""
            lines.append(f"  {name}: value {self.values[name]:.3f}{tried}{ruled}")
        others = [self.values[name] for name in ranked if name != self.action and name in self.allowed]
        if others and self.action in self.values:
            lines.append(f"  ahead of the next allowed action by {self.values[self.action] - max(others):.3f}")
        person = "does not know what the person sees"
        if self.shifted is not None:
            person = f"takes the person to see {self.shifted}"
        lines.append(f"  it sees the code {self.code} and {person}")
        if self.influence:
            moves = ", ".join(f"{name} {share:.2f}" for name, share in self.influence.items())
            lines.append(f"  unless the person waits it expects of it: {moves}")
        return "\n".join(lines)


def find_cell(run: RunFolder, config: CompareConfig, name: str) -> Cell:
    """The cell of a run that a name, or the beginning of one, means.

    Looked for among the cells of the comparison that the run is configured for, and those that it holds results of.

    Raises:
        UserError: there is none that acts on percepts.
    """
    cells = [cell for cell in (*grid(config), *_cells_with_results(run)) if cell.agent in ("dqn", "pomdp", "search")]
    exact = [cell for cell in cells if cell.name == name]
    found = exact or [cell for cell in cells if cell.name.startswith(name)]
    # of several that differ in the influence mode only, the one that perceives minds
    usual = [cell for cell in found if cell.influence == "perspective-shift"]
    chosen = usual if len(found) > 1 and usual else found
    if not chosen:
        there = ", ".join(sorted({cell.name for cell in cells})) or "none (nesy compare makes some)"
        raise UserError(f"no agent '{name}' with values of its own; there are {there}")
    return chosen[0]


def _cells_with_results(run: RunFolder) -> list[Cell]:
    """The cells of this and earlier comparisons that results/cells/ holds."""
    keys = ["agent", "inputs", "influence", "variant", "seed"]
    found = []
    for path in sorted((run.results / "cells").glob("*.parquet")):
        try:
            rows = pq.read_table(path, columns=keys).slice(0, 1).to_pylist()
        except (OSError, pa.ArrowException):
            continue  # cut off: the next comparison makes it anew
        found += [Cell(**row) for row in rows if all(row[key] is not None for key in keys)]
    return found


def explain_choice(
    run: RunFolder,
    domain: Domain,
    config: CompareConfig,
    cell: Cell,
    view: np.ndarray,
    configuration: int,
    seed: int,
    rules: tuple[str, ...] = (),
) -> Choice:
    """Why a cell's agent acts as it does at the start of an episode.

    Args:
        run: the run folder, with the trained policy or the planner's tables.
        domain: the domain.
        config: of the comparison.
        cell: the agent.
        view: uint8 [V, V], what the robot sees.
        configuration: where it sees the person; 0: nowhere.
        seed: of the run.
        rules: further rule files.

    Raises:
        UserError: the agent's files are missing, or it looks into the person's head.
    """
    player = restored_player(cell, run, domain, replace(config, rules=(*config.rules, *rules)), seed)
    perception = player.perception
    if perception is None or perception.needs_person_views:
        raise UserError(f"{cell.name}: it is told what the person sees, which one view does not say; take another")
    observation = {"view": view[None], "configuration": np.array([configuration])}
    percepts = perception(observation, np.zeros_like(view[None]))
    allowed = None if player.mask is None else player.mask(percepts.codes, percepts.configurations)
    # neither a learner nor a planner looks at the environment
    env: Any = None
    situation = Situation(env, observation, percepts, np.ones(1, np.bool_), None, allowed)
    actions = np.asarray(player.agent.actions(situation), np.int64)
    action = int((actions if allowed is None else permitted(actions, allowed))[0])
    names = domain.spec.action_names
    values, visits = _values(player.agent, percepts, names, None if allowed is None else allowed[0])
    believed = player.agent.person_belief()
    known = believed is not None and says_something(believed)[0]
    because = {}
    if isinstance(player.mask, ShieldMask):
        because = player.mask.advise(percepts.codes[0], configuration).because
    return Choice(
        agent=cell.name,
        algorithm=player.agent.algorithm,
        model=player.agent.model,
        action=names[action],
        values=values,
        visits=visits,
        allowed=tuple(n for a, n in enumerate(names) if allowed is None or allowed[0, a]),
        because=because,
        code=tuple(int(v) for v in percepts.codes[0]),
        shifted=tuple(int(v) for v in believed[0].argmax(axis=1)) if known and believed is not None else None,
        influence=_influence(player.agent, names),
    )


def _influence(agent: Any, names: tuple[str, ...]) -> dict[str, float]:
    """What a planner expected the person to do when it acted."""
    expected = agent.infos[0]["influence"] if isinstance(agent, BeliefAgent) else []
    return {name: float(share) for name, share in zip(names, expected, strict=False)}


def _values(
    agent: Any, percepts: Percepts, names: tuple[str, ...], allowed: np.ndarray | None
) -> tuple[dict[str, float], dict[str, int]]:
    if isinstance(agent, DQNAgent):
        return dict(zip(names, map(float, agent.policy.values(percepts)[0]), strict=True)), {}
    info: dict[str, Any] = agent.infos[0]
    visits = [int(v) for v in info["visits"]]
    # a planner under rules may list the allowed actions only
    tried = names if allowed is None or len(visits) == len(names) else tuple(np.array(names)[allowed].tolist())
    values = {name: float(v) for name, v, n in zip(tried, info["values"], visits, strict=True) if n}
    return values, dict(zip(tried, visits, strict=True))
