"""Watch an episode, or drive the robot with the keyboard; record it as GIF (or MP4 where ffmpeg is installed).

In a terminal: arrow keys or w/a/d move, space stays, r starts anew, q quits. Anywhere else, or with --agent,
a policy drives: random, goal (A* to the goal), follower (A* to the person), optimum (exact) or a trained one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from nesy.errors import UserError

ANEW = -1
"""What the keyboard chooses instead of an action: another episode."""
KEYS = {"r": ANEW, "\x1b[A": 2, "\x1b[C": 1, "\x1b[D": 0, "w": 2, "d": 1, "a": 0, " ": 3}
HEADINGS = "▶▼◀▲"
CELLS = ("  ", "██", "▒▒")


@dataclass(frozen=True)
class Arguments:
    """Options of `nesy play`."""

    variant: str = "paper"
    """Variant of the task."""
    size: int | None = None
    """Side of the map, odd (default: the variant's)."""
    seed: int = 0
    """Seed of the maps."""
    agent: Literal["keyboard", "random", "goal", "follower", "optimum"] = "keyboard"
    """Who drives."""
    policy: Path | None = None
    """Let this trained policy drive, such as runs/demo/policies/NAME.safetensors, with its run's world model."""
    episodes: int = 1
    """Episodes to play."""
    record: Path | None = None
    """Write the frames to this file: .gif, or .mp4 where ffmpeg is installed."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result as one JSON object on standard output."""


def run(options: Arguments) -> dict[str, Any]:
    """Play the episodes; returns what came of them."""
    import gymnasium

    if options.episodes < 1:
        raise UserError(f"--episodes {options.episodes}: at least one episode is needed")
    if options.record is not None and options.record.suffix not in (".gif", ".mp4"):
        raise UserError(f"--record {options.record}: the ending must be .gif or .mp4")
    by_hand = options.agent == "keyboard" and options.policy is None
    if by_hand and not sys.stdin.isatty():
        raise UserError("--agent keyboard needs a terminal; name another driver, such as --agent follower")
    parameters: dict[str, Any] = {} if options.size is None else {"size": options.size}
    env = gymnasium.make("nesy/PersonFollowing-v0", variant=options.variant, render_mode="rgb_array", **parameters)
    frames: list[np.ndarray] = []
    episodes = []
    with _keyboard() if by_hand else _policy(env, options) as choose:
        for episode in range(options.episodes):
            result = _episode(env, choose, frames, options, seed=options.seed if episode == 0 else None)
            if result is None:
                break
            episodes.append(result)
    if options.record is not None and frames:
        _write(frames, options.record)
    return {"episodes": episodes, **({"recorded": str(options.record)} if options.record else {})}


def _episode(
    env: Any, choose: Callable[[], int | None], frames: list[np.ndarray], options: Arguments, seed: int | None
) -> dict[str, Any] | None:
    """One episode; None when the driver quits."""
    _, info = env.reset(seed=seed)
    total, steps, ended = 0.0, 0, False
    while True:
        if options.record is not None:
            frames.append(env.render())
        if options.agent == "keyboard" and options.policy is None:
            _draw(env.unwrapped.state(), total, info)
        if ended:
            return {"return": round(total, 4), "length": steps, "outcome": info["outcome"]}
        action = choose()
        if action is None:
            return None
        if action == ANEW:
            _, info = env.reset()
            total, steps = 0.0, 0
            frames.clear()
            continue
        _, reward, terminated, truncated, info = env.step(action)
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated


@contextmanager
def _policy(env: Any, options: Arguments) -> Iterator[Callable[[], int | None]]:
    rng = np.random.default_rng(options.seed)
    if options.policy is not None:
        yield _trained(env, options.policy)
    elif options.agent == "random":
        yield lambda: int(rng.integers(4))
    elif options.agent == "optimum":
        yield _optimum(env, options)
    else:
        yield lambda: int(env.unwrapped.expert_action(options.agent))


def _trained(env: Any, path: Path) -> Callable[[], int]:
    from planners.comparison.players import agent_from_file

    agent, perception = agent_from_file(path)
    batch = env.unwrapped.batch

    def choose() -> int:
        observation = {"view": batch.last.robot_view, "configuration": batch.last.configuration}
        return int(agent.policy.actions(perception(observation, batch.describe()[0]))[0])

    return choose


def _optimum(env: Any, options: Arguments) -> Callable[[], int]:
    from domains.core import load_domain

    parameters: dict[str, Any] = {} if options.size is None else {"size": options.size}
    oracle = load_domain().optimum(options.variant, **parameters)
    return lambda: int(oracle.actions(env.unwrapped)[0])


@contextmanager
def _keyboard() -> Iterator[Callable[[], int | None]]:
    """The keyboard, key by key; the terminal is put back as it was whatever happens."""
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def choose() -> int | None:
        while True:
            key = os.read(descriptor, 1).decode(errors="ignore")
            if key == "\x1b":  # the arrow keys are three characters
                key += os.read(descriptor, 2).decode(errors="ignore")
            if key in ("q", "\x03", ""):
                return None
            if key in KEYS:
                return KEYS[key]

    try:
        tty.setcbreak(descriptor)
        yield choose
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _draw(state: dict[str, Any], total: float, info: dict[str, Any]) -> None:
    """The map in characters on standard error: walls, goal, the robot (red) and the person (blue)."""
    grid = np.asarray(state["grid"])
    lines = []
    for y in range(grid.shape[1]):
        row = [CELLS[kind] for kind in grid[:, y]]
        for who, colour in (("person", 34), ("agent", 31)):
            if state[who][1] == y:
                row[state[who][0]] = f"\x1b[{colour};1m{HEADINGS[state[who][2]]} \x1b[0m"
        lines.append("".join(row))
    lines.append(f"step {state['t']}  return {total:.2f}  distance {info.get('distance')}  {info.get('outcome', '')}")
    print("\x1b[H\x1b[2J" + "\n".join(lines), file=sys.stderr, flush=True)


def _write(frames: list[np.ndarray], path: Path) -> None:
    from matplotlib import animation
    from PIL import Image

    from nesy.run_folder import atomic_path

    with atomic_path(path) as temporary:
        if path.suffix == ".gif":
            images = [Image.fromarray(frame) for frame in frames]
            images[0].save(temporary, save_all=True, append_images=images[1:], duration=200, loop=0)
        elif not animation.FFMpegWriter.isAvailable():
            raise UserError(f"--record {path}: MP4 needs the program ffmpeg, which is not installed; use .gif")
        else:
            _write_mp4(frames, temporary)


def _write_mp4(frames: list[np.ndarray], path: Path) -> None:
    from matplotlib import animation
    from matplotlib import pyplot as plt

    height, width = frames[0].shape[:2]
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    image = axes.imshow(frames[0])
    writer = animation.FFMpegWriter(fps=5)
    with writer.saving(figure, str(path), dpi=100):
        for frame in frames:
            image.set_data(frame)
            writer.grab_frame()
    plt.close(figure)


def show(result: dict[str, Any]) -> None:
    """Print one line per episode."""
    for episode in result["episodes"]:
        print(f"{episode['outcome']}: return {episode['return']:.2f} in {episode['length']} steps")
    if "recorded" in result:
        print(f"recorded: {result['recorded']}")
