"""Small models of minds, and the filter over them by brute force."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from domains.core import FORWARD, STAY, load_domain
from nesy.config import CollectConfig
from nesy.log.collection import collect, collect_following
from nesy.log.experience import Experience
from planners.person_following.ialm_learning import joined
from planners.person_following.structured.known_maps.minds import MAX_WALK, MindModel
from planners.person_following.structured.known_maps.ways import Node, Ways

MAPS = 6


class DigitCodec:
    """A code is what a checksum of the view says: enough to tell views apart."""

    num_values = 8

    def codes(self, views: np.ndarray) -> np.ndarray:
        flat = views.reshape(len(views), -1).astype(np.uint64)
        sums = (flat * (np.arange(flat.shape[1], dtype=np.uint64) * np.uint64(2654435761) + np.uint64(97))).sum(1)
        return (sums[:, None] >> np.arange(0, 32, 4, dtype=np.uint64) & np.uint64(7)).astype(np.uint8)


CODEC: Any = DigitCodec()


def experience_of(variant: str, folder: Path) -> Experience:
    """A few hundred episodes on some maps."""
    domain = load_domain("person_following")
    config = CollectConfig(crossing_episodes=0, following_episodes=240)
    collect(domain, config, folder / "walks", 3, variant=variant)
    collect_following(domain, 3000, 0.3, folder / "practice", 3, variant=variant)
    experience = joined(Experience.load(folder / "walks"), Experience.load(folder / "practice"))
    maps = np.unique(experience.map_id[np.char.startswith(experience.source, "following")])[::7]
    return experience.select(np.isin(experience.map_id, maps))


def starts(model: MindModel) -> list[Node]:
    return [
        (s, 0, p, k, k, -1, 0)
        for s, p, _ in model.intentions.starts.tolist()
        for k in range(2)
        if model.scenes.goals[s, k] >= 0
    ]


def brute_force(
    ways: Ways, model: MindModel, actions: list[int], seen: list[tuple[np.ndarray, np.ndarray | None]]
) -> dict[tuple[int, int, int], float]:
    """P(s, z, g | what was seen), by going through every course of events one by one."""
    scenes, noise = model.scenes, max(model.code_noise, 1e-4)
    found: dict[tuple[int, int, int], float] = {}

    def sight(s: int, q: int, p: int) -> bool:
        return bool(scenes.sees[s, q, scenes.cell[s, p]] and scenes.cell[s, q] != scenes.cell[s, p])

    def likelihood(s: int, q: int, p: int, gone: int, k: int) -> float:
        code, pose = seen[k]
        if sight(s, q, p) != (pose is not None):
            return 0.0
        if pose is not None and tuple(scenes.relative(*map(np.array, ([s], [q], [p])))[0]) != tuple(pose):
            return 0.0
        view = scenes.view[s, q].copy()
        for candidate, cell in enumerate(scenes.goals[s]):
            covered = pose is not None and scenes.cell[s, p] == cell
            if cell >= 0 and scenes.sees[s, q, cell] and (candidate == gone or covered):
                vx, vy = scenes.place_in_view(np.array([s]), np.array([q]), np.array([cell]), 5)
                view[vx[0], vy[0]] = 0
        wrong = int((CODEC.codes(view[None])[0] != code).sum())
        return float((1 - noise) ** (len(code) - wrong) * noise**wrong)

    def walk(k: int, weight: float, s: int, q: int, p: int, z: int, g: int, gone: int, lost: int, stood: int) -> None:
        weight *= likelihood(s, q, p, gone, k)
        if weight <= 0.0:
            return
        if k == len(actions):
            found[s, z, g] = found.get((s, z, g), 0.0) + weight
            return
        action = actions[k]
        options = [(g, gone, 1.0)]
        if gone < 0:
            chance = model.vanish_chance(k, ways.seen(s, p, g))
            options = [(g, gone, 1.0 - chance), (1 - g, g, chance)]
        faced = scenes.follows[s, q, FORWARD]
        person_ahead = faced != q and scenes.cell[s, faced] == scenes.cell[s, p]
        wall = action == FORWARD and faced == q
        moved = 1.0 if action == STAY else float(model.moved_chance[k, action, int(wall), int(person_ahead)])
        for own, left, share in options:
            for then, moves in ((int(scenes.follows[s, q, action]), moved), (q, 1.0 - moved)):
                if moves == 0.0 or share == 0.0:
                    continue
                for u in range(4):
                    there = int(scenes.follows[s, p, u]) if u != STAY else p
                    heads = own if own != z and ways.seen(s, there, z) else z
                    cell, person = scenes.cell[s, then], scenes.cell[s, there]
                    length = min(int(scenes.walk[s, then, person]), MAX_WALK)
                    home = scenes.goals[s, own]
                    front = scenes.follows[s, then, FORWARD]
                    standing = min(stood + 1, 8) if person == home else 0
                    variables = (
                        length,
                        int(sight(s, then, there)),
                        int(person == home),
                        standing,
                        lost,
                        int(cell == home and then != q and action == FORWARD),
                        int(action == FORWARD and front != then and scenes.cell[s, front] == person),
                        int(cell == person),
                    )
                    goes_on = float(model.judgement[variables][1])
                    after = int(model.lost_chance[length, lost].argmax())
                    chance = weight * share * moves * float(model.policy[s, z, p, u]) * goes_on
                    walk(k + 1, chance, s, then, there, heads, own, left, after, standing)

    for s, p, count in model.intentions.starts.tolist():
        for z in range(2):
            walk(0, count * float(model.intentions.prior[s, z]), s, 0, p, z, z, -1, 0, 0)
    total = sum(found.values())
    return {key: weight / total for key, weight in found.items()}
