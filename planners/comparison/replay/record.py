"""Replays: a few episodes of the comparison played again, with everything that was seen, believed and weighed.

Which episodes is decided by a rule that looks at results alone: of every agent under every condition (first seed)
the first success, the first failure, and the episode with the worst regret (the optimum's return on the episode
minus its own; without the optimum among the agents there is none). The episodes start and run as they did in the
comparison, so each return must be the recorded one; `reproduced` says whether it is.

results/replays.json   maps, and per episode its steps: state, view, b, b~, decoded views, values, tree, rules
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from domains.core import WALL, Domain, load_domain
from nesy.errors import UserError
from nesy.progress import SILENT, Progress
from nesy.run_folder import RunFolder, atomic_path, read_json
from planners.agents import Agent, BeliefAgent, says_something
from planners.comparison.evaluation import Player, evaluation_maps
from planners.comparison.grid import EVALUATION_SEED, Cell, cell_path, grid
from planners.comparison.players import restored_player
from planners.comparison.replay.choice import MOST_EPISODES, Chosen, all_reasons, choose
from planners.config import CompareConfig
from planners.perception import Perception, Percepts
from planners.search.tree import Tree
from planners.search.tree_top import in_words, top_of_flat_tree, top_of_pomdp_py_tree

FORMAT, VERSION = "nesy-replays", 2
RULE = (
    "of every agent under every condition, first seed: the first success, the first failure, and the worst regret "
    "(the optimum's return on the same episode minus its own)"
)


def record_replays(
    run: RunFolder,
    config: CompareConfig,
    seed: int = 0,
    progress: Progress = SILENT,
    domain_name: str = "person_following",
) -> Path:
    """Play the chosen episodes of a finished comparison again and write results/replays.json.

    Does nothing if the file is there already and belongs to the same comparison.

    Args:
        run: a run with a finished comparison.
        config: of the comparison.
        seed: of the run.
        progress: told of finished episodes.
        domain_name: which domain.

    Raises:
        UserError: a file of the comparison is missing or damaged.
    """
    path = run.results / "replays.json"
    cells = [cell for cell in grid(config) if cell.seed == config.seeds[0]]
    tables = {cell: _evaluated(run, cell) for cell in cells}
    fingerprint = _fingerprint(run, cells)
    if path.is_file() and _is_current(path, fingerprint):
        return path
    chosen = choose(tables)
    domain = load_domain(domain_name)
    maps: dict[str, int] = {}
    episodes: list[dict[str, Any]] = []
    with progress.task("replays", sum(len(picked) for picked in chosen.values())) as task:
        for cell, picked in chosen.items():
            if picked:
                episodes += _play(run, domain, cell, picked, len(tables[cell]["return"]), config, seed, maps)
                task.advance(len(picked))
    document = {
        "format": FORMAT,
        "version": VERSION,
        "fingerprint": fingerprint,
        "rule": RULE,
        "left_out": sum(len(all_reasons(tables, cell)) for cell in cells) - len(episodes),
        "action_names": list(domain.spec.action_names),
        "cell_kinds": list(domain.spec.cell_kinds),
        "maps": [{"size": int(len(cells_of) ** 0.5), "cells": cells_of} for cells_of in maps],
        "episodes": episodes,
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")
    return path


def load_replays(path: Path) -> dict[str, Any]:
    """Read results/replays.json.

    Raises:
        UserError: the file is missing, damaged or of another version.
    """
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT or value.get("version") != VERSION:
        raise UserError(f"{path}: not a file of replays of version {VERSION}; delete it and call: nesy report")
    return value


def _evaluated(run: RunFolder, cell: Cell) -> dict[str, list[Any]]:
    path = cell_path(run, cell)
    try:
        table = pq.read_table(path, columns=["phase", "episode", "return", "outcome", "map_id"])
    except (OSError, pa.ArrowException) as error:
        raise UserError(
            f"{path}: not readable as Parquet ({type(error).__name__}); make it with: nesy compare"
        ) from None
    rows = table.filter(pa.compute.equal(table["phase"], "eval")).sort_by("episode")
    return {name: rows[name].to_pylist() for name in ("return", "outcome", "map_id")}


def _fingerprint(run: RunFolder, cells: Sequence[Cell]) -> str:
    """Changes whenever a cell has been run anew with other settings."""
    marks = [[cell.name, (pq.read_schema(cell_path(run, cell)).metadata or {}).get(b"fingerprint", b"").decode()]
             for cell in cells]  # fmt: skip
    return hashlib.sha256(json.dumps([VERSION, MOST_EPISODES, RULE, marks]).encode()).hexdigest()


def _is_current(path: Path, fingerprint: str) -> bool:
    try:
        return bool(load_replays(path)["fingerprint"] == fingerprint)
    except (UserError, KeyError):
        return False


def _play(
    run: RunFolder,
    domain: Domain,
    cell: Cell,
    chosen: list[Chosen],
    episodes: int,
    config: CompareConfig,
    seed: int,
    maps: dict[str, int],
) -> list[dict[str, Any]]:
    """Play the cell's episodes as `evaluate` does, deciding and recording in the chosen ones."""
    player = restored_player(cell, run, domain, config, seed)
    agent, perception = player.agent, player.perception
    shield = None if perception is None else _shield(config, perception, domain)
    start_maps = evaluation_maps(domain, cell.variant, episodes)
    env: Any = domain.make(
        domain.spec.main_task,
        episodes,
        variant=cell.variant,
        seed=EVALUATION_SEED + cell.seed,
        maps=start_maps,
        cycle=True,
    )
    observation, _ = env.reset(seed=EVALUATION_SEED + cell.seed)
    active = np.zeros(episodes, np.bool_)
    active[[item.episode for item in chosen]] = True
    steps: dict[int, list[dict[str, Any]]] = {item.episode: [] for item in chosen}
    outcomes: dict[int, str] = {}
    last: np.ndarray | None = None
    while active.any():
        person_views = env.person_views()
        actions, percepts = player.decide(env, observation, active, last)
        believed = agent.person_belief()
        states = env.states()
        moments = {
            int(i): {
                **_scene(states[i], maps),
                **_senses(observation, person_views, domain, int(i)),
                **_beliefs(player, percepts, believed, int(i)),
                **_thoughts(agent, percepts, int(i)),
                **_rules(shield, percepts, domain, int(i)),
                "action": int(actions[i]),
            }
            for i in np.flatnonzero(active)
        }
        observation, reward, terminated, truncated, infos = env.step(actions)
        for i, moment in moments.items():
            steps[i].append({**moment, "reward": round(float(reward[i]), 4)})
            if terminated[i] or truncated[i]:
                outcomes[i] = domain.spec.outcomes[int(infos["outcome_code"][i])]
                active[i] = False
        last = actions
    env.close()
    return [_record(cell, item, steps[item.episode], outcomes[item.episode], agent) for item in chosen]


def _record(cell: Cell, item: Chosen, steps: list[dict[str, Any]], outcome: str, agent: Agent) -> dict[str, Any]:
    total = sum(step["reward"] for step in steps)
    return {
        **asdict(cell),
        "algorithm": agent.algorithm,
        "model": agent.model,
        "episode": item.episode,
        "why": list(item.reasons),
        "outcome": outcome,
        "return": round(item.total, 3),
        "regret": None if item.regret is None else round(item.regret, 3),
        "reproduced": outcome == item.outcome and abs(total - item.total) < 1e-3 * max(len(steps), 1),
        "steps": steps,
    }


def _shield(config: CompareConfig, perception: Perception, domain: Domain) -> Any:
    """The rules of the comparison, to be asked which of them apply; None without rules."""
    rules: tuple[str, ...] = getattr(config, "rules", ())
    if not rules:
        return None
    from planners.shielding import ShieldMask

    codec: Any = perception.codec
    return ShieldMask([Path(rule) for rule in rules], codec, domain)


def _scene(state: dict[str, Any], maps: dict[str, int]) -> dict[str, Any]:
    """The true state, its map stored once."""
    cells = _digits(_squared(np.asarray(state["grid"])))
    scene: dict[str, Any] = {"map": maps.setdefault(cells, len(maps))}
    for name in ("agent", "person", "goal"):
        if state.get(name) is not None:
            scene[name] = [int(number) for number in np.asarray(state[name]).reshape(-1)]
    for name in ("waiting", "lost"):
        if name in state:
            scene[name] = int(state[name])
    return scene


def _senses(observation: dict[str, np.ndarray], person_views: np.ndarray, domain: Domain, i: int) -> dict[str, Any]:
    """What the robot and the person see: views as digits [vx][vy], and where the robot sees the person."""
    configuration = int(observation["configuration"][i])
    seen = [int(part[0]) for part in domain.spec.geometry.decode(np.array([configuration]))]
    return {
        "view": _digits(observation["view"][i]),
        "seen": seen if configuration > 0 else None,
        "person_view": _digits(person_views[i]),
    }


def _beliefs(player: Player, percepts: Percepts | None, believed: np.ndarray | None, i: int) -> dict[str, Any]:
    """What the agent acted on, as values or distributions per factor, and the views that these mean.

    b where it acts on its code; `believed` [B, N, K] of what the person sees. An agent that keeps neither shows none,
    and where a belief says nothing there is no view.
    """
    shown: dict[str, Any] = dict.fromkeys(("belief", "decoded", "shifted", "decoded_shifted"))
    if percepts is None:
        return shown
    codec: Any = player.codec
    if not isinstance(player.agent, BeliefAgent) or player.agent.acts_on_code:
        shown["belief"] = _distributions(percepts.beliefs[i])
        shown["decoded"] = _digits(codec.views(percepts.beliefs[i : i + 1].argmax(axis=2).astype(np.uint8))[0])
    if believed is not None:
        shown["shifted"] = _distributions(believed[i])
        if says_something(believed)[i]:
            shown["decoded_shifted"] = _digits(codec.views(believed[i : i + 1].argmax(axis=2).astype(np.uint8))[0])
    return shown


def _thoughts(agent: Agent, percepts: Percepts | None, i: int) -> dict[str, Any]:
    """The values that the agent weighed: of a value network, or of a search with the top of its tree."""
    policy: Any = getattr(agent, "policy", None)
    if percepts is not None and hasattr(policy, "values"):
        one = Percepts(*(part[i : i + 1] for part in percepts))
        return {"q": [round(float(value), 3) for value in policy.values(one)[0]]}
    if not isinstance(agent, BeliefAgent):
        return {}
    info, planner, belief = agent.infos[i], agent.planners[i], agent.beliefs[i]
    plan: dict[str, Any] = {
        "values": [round(float(value), 3) for value in info["values"]],
        "visits": [int(count) for count in info["visits"]],
        "simulations": int(info["simulations"]),
        "influence": [round(float(share), 3) for share in info["influence"]],
        "tree": _tree_of(planner, belief.window),
        "where": _places(belief.pose_marginal(), belief.window),
        "person": _distributions(belief.person_marginals()),
    }
    return {"plan": plan}


def _tree_of(planner: Any, window: int) -> dict[str, Any] | None:
    """The top of the last search's tree, its observations in words."""

    def of_adapter(seen: Any) -> str:
        side, ahead, _ = seen.pose
        where = "not in view" if side < 0 else in_words(side - window, ahead - window)
        return where if not seen.outcome else f"{where}, the end"

    if getattr(planner, "root", None) is not None:
        return top_of_pomdp_py_tree(planner.root, of_adapter)
    tree = getattr(planner, "tree", None)
    return top_of_flat_tree(tree, planner.describe) if isinstance(tree, Tree) else None


def _rules(shield: Any, percepts: Percepts | None, domain: Domain, i: int) -> dict[str, Any]:
    """Which actions the rules leave here, and which rules forbid the others."""
    if shield is None or percepts is None:
        return {}
    advice = shield.advise(percepts.codes[i], int(percepts.configurations[i]))
    return {
        "rules": {
            "allowed": [bool(value) for value in advice.allowed],
            "preferred": [bool(value) for value in advice.preferred],
            "because": {name: list(places) for name, places in advice.because.items()},
            "conflict": bool(advice.conflict),
        }
    }


def _squared(grid: np.ndarray) -> np.ndarray:
    """A map [width, height] as a square one: beyond its border there is wall."""
    side = max(grid.shape)
    return np.pad(grid, [(0, side - length) for length in grid.shape], constant_values=WALL)


def _digits(view: Any) -> str:
    """Cell kinds [x, y] as one text, x by x."""
    return "".join(str(int(kind)) for kind in np.asarray(view).reshape(-1))


def _distributions(belief: np.ndarray) -> list[Any]:
    """Per factor its value where certain, else its distribution."""
    certain = belief.max(axis=1) >= 1.0 - 1e-6
    rounded: Callable[[np.ndarray], list[float]] = lambda row: [round(float(p), 3) for p in row]  # noqa: E731
    return [int(row.argmax()) if sure else rounded(row) for row, sure in zip(belief, certain, strict=True)]


def _places(marginal: np.ndarray, window: int, most: int = 40) -> list[list[float]]:
    """The most probable relative places of the person: [side, ahead, probability]."""
    places = marginal.sum(axis=2)
    order = np.argsort(-places, axis=None, kind="stable")[:most]
    sides, aheads = np.unravel_index(order, places.shape)
    return [
        [int(side) - window, int(ahead) - window, round(float(places[side, ahead]), 3)]
        for side, ahead in zip(sides, aheads, strict=True)
        if places[side, ahead] >= 5e-4
    ]
