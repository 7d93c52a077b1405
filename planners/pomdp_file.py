"""Cassandra's `.pomdp` file format: reading all of it, writing a sparse form of it.

Preamble `discount`, `values` (reward or cost), `states`, `actions`, `observations` (a number or names), `start`
(probabilities, uniform, one state, include, exclude); then `T`, `O` and `R` entries for single numbers, rows or
whole matrices, with `*` for all, `identity` and `uniform`. Later entries replace earlier ones.
Source: A. Cassandra, "POMDP file format", pomdp.org.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy import sparse

from nesy.errors import UserError
from nesy.run_folder import atomic_path
from planners.pomdp import TabularPOMDP

_KEYWORDS = ("discount", "values", "states", "actions", "observations", "start", "T", "O", "R")
_LARGEST = 60_000_000  # entries of one action's reward table


def read(path: Path) -> TabularPOMDP:
    """Read a model.

    Raises:
        UserError: the file is missing, or a line is not understood; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from None
    return _Reader(text, str(path)).model()


class _Reader:
    """Tokens of one file, with their lines, and what has been read so far."""

    def __init__(self, text: str, name: str) -> None:
        self.name, self.at = name, 0
        self.tokens: list[str] = []
        self.lines: list[int] = []
        for number, line in enumerate(text.splitlines(), 1):
            for token in re.findall(r":|[^\s:]+", line.split("#", 1)[0]):
                self.tokens.append(token)
                self.lines.append(number)
        self.names: dict[str, list[str]] = {}
        self.discount, self.sign = 1.0, 1.0
        self.start: np.ndarray | None = None

    def fail(self, message: str) -> UserError:
        line = self.lines[min(self.at, len(self.lines) - 1)] if self.lines else 1
        return UserError(f"{self.name}, line {line}: {message}")

    def peek(self, ahead: int = 0) -> str | None:
        position = self.at + ahead
        return self.tokens[position] if position < len(self.tokens) else None

    def take(self) -> str:
        if self.at >= len(self.tokens):
            raise self.fail("the file ends in the middle of an entry")
        self.at += 1
        return self.tokens[self.at - 1]

    def colon(self) -> None:
        if self.peek() != ":":
            raise self.fail(f"expected ':', found '{self.peek()}'")
        self.at += 1

    def number(self) -> float:
        token = self.take()
        try:
            return float(token)
        except ValueError:
            self.at -= 1
            raise self.fail(f"expected a number, found '{token}'") from None

    def numbers(self, count: int) -> np.ndarray:
        return np.array([self.number() for _ in range(count)])

    def at_keyword(self) -> bool:
        return self.peek() in _KEYWORDS and (self.peek(1) == ":" or self.peek() == "start")

    def which(self, kind: str) -> np.ndarray:
        """Indices that a name, a number or `*` stands for."""
        names, token = self.names[kind], self.take()
        if token == "*":
            return np.arange(len(names))
        if token in names:
            return np.array([names.index(token)])
        if token.isdigit() and int(token) < len(names):
            return np.array([int(token)])
        self.at -= 1
        raise self.fail(f"unknown {kind[:-1]} '{token}'")

    def model(self) -> TabularPOMDP:
        while self.at_keyword() and self.peek() not in ("T", "O", "R"):
            self.preamble()
        for kind in ("states", "actions", "observations"):
            if not self.names.get(kind):
                raise self.fail(f"the preamble lacks '{kind}:'")
        num_states, num_actions = len(self.names["states"]), len(self.names["actions"])
        num_observations = len(self.names["observations"])
        transition = np.zeros((num_actions, num_states, num_states))
        observation = np.zeros((num_actions, num_states, num_observations))
        rewards: list[tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray]] = []
        while self.at < len(self.tokens):
            keyword = self.take()
            if keyword not in ("T", "O", "R"):
                self.at -= 1
                raise self.fail(f"expected 'T:', 'O:' or 'R:', found '{keyword}'")
            self.colon()
            if keyword == "R":
                rewards.append(self.reward_entry())
            else:
                columns = "states" if keyword == "T" else "observations"
                self.matrix_entry(transition if keyword == "T" else observation, columns, keyword)
        reward = self.expected_reward(rewards, transition, observation)
        start = np.full(num_states, 1.0 / num_states) if self.start is None else self.start
        stays = (transition[:, np.arange(num_states), np.arange(num_states)] > 1 - 1e-12).all(axis=0)
        try:
            return TabularPOMDP(
                states=tuple(self.names["states"]),
                actions=tuple(self.names["actions"]),
                observations=tuple(self.names["observations"]),
                transition=[sparse.csr_array(matrix) for matrix in transition],
                observation=observation,
                reward=reward,
                discount=self.discount,
                start=start,
                terminal=stays & (reward == 0).all(axis=0),
            )
        except UserError as error:
            raise UserError(f"{self.name}: {error}") from None

    def preamble(self) -> None:
        keyword = self.take()
        if keyword == "start":
            self.read_start()
            return
        self.colon()
        if keyword == "discount":
            self.discount = self.number()
        elif keyword == "values":
            kind = self.take()
            if kind not in ("reward", "cost"):
                raise self.fail(f"values are 'reward' or 'cost', not '{kind}'")
            self.sign = 1.0 if kind == "reward" else -1.0
        else:
            words = []
            while self.at < len(self.tokens) and not self.at_keyword():
                words.append(self.take())
            if len(words) == 1 and words[0].isdigit():
                words = [str(i) for i in range(int(words[0]))]
            if len(set(words)) != len(words):
                raise self.fail(f"a name occurs twice in '{keyword}:'")
            self.names[keyword] = words

    def read_start(self) -> None:
        if "states" not in self.names:
            raise self.fail("'start' comes before 'states:'")
        count = len(self.names["states"])
        chosen = self.take() if self.peek() in ("include", "exclude") else None
        self.colon()
        if chosen is not None:
            listed = np.zeros(count, np.bool_)
            while self.at < len(self.tokens) and not self.at_keyword():
                listed[self.which("states")] = True
            mask = listed if chosen == "include" else ~listed
            if not mask.any():
                raise self.fail("no state is left to start in")
            self.start = mask / mask.sum()
        elif self.peek() == "uniform":
            self.take()
            self.start = np.full(count, 1.0 / count)
        elif self._words_to_keyword() == 1 and count > 1:
            self.start = np.zeros(count)
            self.start[self.which("states")] = 1.0
        else:
            self.start = self.numbers(count)

    def _words_to_keyword(self) -> int:
        """How many tokens there are before the next keyword."""
        begin = self.at
        while self.at < len(self.tokens) and not self.at_keyword():
            self.at += 1
        count, self.at = self.at - begin, begin
        return count

    def matrix_entry(self, table: np.ndarray, columns: str, keyword: str) -> None:
        actions = self.which("actions")
        if self.peek() != ":":
            table[actions] = self.block(table.shape[1:], keyword == "T")
            return
        self.colon()
        rows = self.which("states")
        if self.peek() != ":":
            table[np.ix_(actions, rows)] = self.block(table.shape[2:], False)
            return
        self.colon()
        chosen = self.which(columns)
        table[np.ix_(actions, rows, chosen)] = self.number()

    def block(self, shape: tuple[int, ...], square: bool) -> np.ndarray:
        if self.peek() == "uniform":
            self.take()
            return np.full(shape, 1.0 / shape[-1])
        if self.peek() == "identity" and square:
            self.take()
            return np.eye(shape[0])
        return self.numbers(int(np.prod(shape))).reshape(shape)

    def reward_entry(
        self,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray]:
        num_states, num_observations = len(self.names["states"]), len(self.names["observations"])
        actions = self.which("actions")
        self.colon()
        states = self.which("states")
        if self.peek() != ":":
            return actions, states, None, None, self.numbers(num_states * num_observations)
        self.colon()
        after = self.which("states")
        if self.peek() != ":":
            return actions, states, after, None, self.numbers(num_observations)
        self.colon()
        seen = self.which("observations")
        return actions, states, after, seen, self.numbers(1)

    def expected_reward(
        self,
        entries: list[tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray]],
        transition: np.ndarray,
        observation: np.ndarray,
    ) -> np.ndarray:
        """R[a, s] = sum_s' T sum_o Z R(a, s, s', o), action by action."""
        num_actions, num_states, num_observations = observation.shape
        if num_states * num_states * num_observations > _LARGEST:
            raise UserError(f"{self.name}: {num_states} states and {num_observations} observations are too many")
        out = np.zeros((num_actions, num_states))
        for a in range(num_actions):
            table = np.zeros((num_states, num_states, num_observations))
            for actions, states, after, seen, values in entries:
                if a not in actions:
                    continue
                if after is None:
                    table[states] = values.reshape(num_states, num_observations)
                elif seen is None:
                    table[np.ix_(states, after)] = values
                else:
                    table[np.ix_(states, after, seen)] = values[0]
            out[a] = self.sign * np.einsum("st,to,sto->s", transition[a], observation[a], table, optimize=True)
        return out


def write(model: TabularPOMDP, path: Path) -> None:
    """Write a model with its non-zero entries; names that are no words are replaced by numbers."""
    lines = [f"discount: {model.discount!r}", "values: reward"]
    for kind in ("states", "actions", "observations"):
        names = getattr(model, kind)
        words = all(re.fullmatch(r"[A-Za-z][\w-]*", name) for name in names) and len(set(names)) == len(names)
        lines.append(f"{kind}: {' '.join(names) if words and not set(names) & set(_KEYWORDS) else len(names)}")
    lines.append("start: " + " ".join(repr(float(p)) for p in model.start))
    for a in range(len(model.actions)):
        entries = sparse.coo_array(model.transition[a])
        lines += [
            f"T: {a} : {s} : {t} {float(p)!r}"
            for s, t, p in zip(entries.row, entries.col, entries.data, strict=True)
            if p
        ]
        lines += [
            f"O: {a} : {s} : {o} {float(model.observation[a, s, o])!r}"
            for s, o in np.argwhere(model.observation[a] != 0)
        ]
        lines += [f"R: {a} : {s} : * : * {float(model.reward[a, s])!r}" for s in np.flatnonzero(model.reward[a])]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
