"""Cassandra's `.pomdp` file format: reading all of it, writing a sparse form of it.

Preamble `discount`, `values` (reward or cost), `states`, `actions`, `observations` (a number or names), `start`
(probabilities, uniform, one state, include, exclude); then `T`, `O` and `R` entries for single numbers, rows or
whole matrices, with `*` for all, `identity`, `uniform` and `reset` (to the start distribution). Later entries replace
earlier ones. Rows that rounding in the file keeps from summing to 1 are scaled. Transitions and rewards are kept
sparse, so files with ten thousand states can be read.
Source: A. Cassandra, "POMDP file format", pomdp.org.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy import sparse

from nesy.errors import UserError
from nesy.run_folder import atomic_path
from planners.explicit.pomdp import TabularPOMDP

_KEYWORDS = ("discount", "values", "states", "actions", "observations", "start", "T", "O", "R")
_ROUNDING = 1e-3  # how far a row may be from summing to 1
_LARGEST = 50_000_000  # entries of a table that a file may name at once
_MOST_NAMES = 1_000_000  # states, actions or observations that a file may count up
RewardEntry = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray]


def read(path: Path) -> TabularPOMDP:
    """Read a model.

    Raises:
        UserError: the file is missing, or a line is not understood; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error})") from None
    return _Reader(text, str(path)).model()


Row = dict[int, float] | np.ndarray
"""One row of transitions: {next state: chance}, or all of it."""


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
        self.places: dict[str, dict[str, int]] = {}
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
            value = float(token)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            self.at -= 1
            raise self.fail(f"expected a number, found '{token}'")
        return value

    def numbers(self, count: int) -> np.ndarray:
        if count > _LARGEST:
            raise self.fail(f"a table of {count} numbers is too large")
        return np.array([self.number() for _ in range(count)])

    def at_keyword(self) -> bool:
        return self.peek() in _KEYWORDS and (self.peek(1) == ":" or self.peek() == "start")

    def which(self, kind: str) -> np.ndarray:
        """Indices that a name, a number or `*` stands for."""
        names, token = self.names[kind], self.take()
        if token == "*":
            return np.arange(len(names))
        if token in self.places[kind]:
            return np.array([self.places[kind][token]])
        if token.isdecimal() and int(token) < len(names):
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
        if num_actions * num_states * num_observations > _LARGEST:
            raise UserError(f"{self.name}: {num_states} states and {num_observations} observations are too many")
        if self.start is None:
            self.start = np.full(num_states, 1.0 / num_states)
        transition: list[list[Row]] = [[{} for _ in range(num_states)] for _ in range(num_actions)]
        observation = np.zeros((num_actions, num_states, num_observations))
        rewards: list[RewardEntry] = []
        while self.at < len(self.tokens):
            keyword = self.take()
            if keyword not in ("T", "O", "R"):
                self.at -= 1
                raise self.fail(f"expected 'T:', 'O:' or 'R:', found '{keyword}'")
            self.colon()
            if keyword == "R":
                rewards.append(self.reward_entry())
            elif keyword == "T":
                self.transition_entry(transition)
            else:
                self.observation_entry(observation)
        matrices = [self.matrix(rows, action) for rows, action in zip(transition, self.names["actions"], strict=True)]
        sums = observation.sum(axis=2, keepdims=True)
        observation = np.where(np.abs(sums - 1) <= _ROUNDING, observation / np.where(sums > 0, sums, 1.0), observation)
        reward = self.expected_reward(rewards, matrices, observation)
        stays = np.all([m.diagonal() > 1 - 1e-12 for m in matrices], axis=0)
        try:
            return TabularPOMDP(
                states=tuple(self.names["states"]),
                actions=tuple(self.names["actions"]),
                observations=tuple(self.names["observations"]),
                transition=matrices,
                observation=observation,
                reward=reward,
                discount=self.discount,
                start=self.start / self.start.sum() if abs(self.start.sum() - 1) <= _ROUNDING else self.start,
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
            if len(words) == 1 and words[0].isdecimal():
                if int(words[0]) > _MOST_NAMES:
                    raise self.fail(f"{words[0]} {keyword} are too many")
                words = [str(i) for i in range(int(words[0]))]
            if not words:
                raise self.fail(f"'{keyword}:' names nothing; at least one is needed")
            if len(set(words)) != len(words):
                raise self.fail(f"a name occurs twice in '{keyword}:'")
            self.names[keyword] = words
            self.places[keyword] = {word: i for i, word in enumerate(words)}

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

    def transition_entry(self, table: list[list[Row]]) -> None:
        actions, count = self.which("actions"), len(self.names["states"])
        if self.peek() != ":":
            rows = self.block((count, count))
            for a in actions:
                for s in range(count):
                    table[a][s] = {s: 1.0} if rows is None else rows[s]
            return
        self.colon()
        states = self.which("states")
        if self.peek() != ":":
            whole = self.block((count,))
            assert whole is not None
            for a in actions:
                for s in states:
                    table[a][s] = whole
            return
        self.colon()
        after, chance = self.which("states"), self.number()
        for a in actions:
            for s in states:
                if len(after) == count:
                    table[a][s] = np.full(count, chance) if chance else {}
                    continue
                row = table[a][s]
                if not isinstance(row, dict):
                    row = dict(enumerate(row.tolist()))
                table[a][s] = row | {int(after[0]): chance}

    def observation_entry(self, table: np.ndarray) -> None:
        actions = self.which("actions")
        if self.peek() != ":":
            table[actions] = self.block(table.shape[1:], uniform_only=True)
            return
        self.colon()
        states = self.which("states")
        if self.peek() != ":":
            table[np.ix_(actions, states)] = self.block(table.shape[2:], uniform_only=True)
            return
        self.colon()
        seen = self.which("observations")
        table[np.ix_(actions, states, seen)] = self.number()

    def block(self, shape: tuple[int, ...], uniform_only: bool = False) -> np.ndarray | None:
        """A row or a matrix of numbers, or the word for one; None stands for the identity."""
        word = self.peek()
        if word == "uniform":
            self.take()
            return np.broadcast_to(np.full(shape[-1], 1.0 / shape[-1]), shape)
        if word == "reset" and not uniform_only:
            self.take()
            assert self.start is not None
            return np.broadcast_to(self.start, shape)
        if word == "identity" and not uniform_only and len(shape) == 2:
            self.take()
            return None
        return self.numbers(int(np.prod(shape))).reshape(shape)

    def matrix(self, rows: list[Row], action: str) -> sparse.csr_array:
        """The rows of one action as a sparse matrix; each sums to 1 up to rounding."""
        count = len(rows)
        indices, values, ends = [], [], [0]
        for s, row in enumerate(rows):
            index, value = (
                (np.array(sorted(row), np.int64), np.array([row[t] for t in sorted(row)], np.float64))
                if isinstance(row, dict)
                else (np.flatnonzero(row), row[np.flatnonzero(row)])
            )
            total = value.sum()
            if abs(total - 1) > _ROUNDING or (value < 0).any():
                state = self.names["states"][s]
                wrong = "hold a negative number" if (value < 0).any() else f"sum to {total:.6g}, not 1"
                raise UserError(f"{self.name}: transitions of action '{action}' in state '{state}' {wrong}")
            indices.append(index[value > 0])
            values.append(value[value > 0] / total)
            ends.append(ends[-1] + len(indices[-1]))
        return sparse.csr_array((np.concatenate(values), np.concatenate(indices), np.array(ends)), (count, count))

    def reward_entry(self) -> RewardEntry:
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
        self, entries: list[RewardEntry], transition: list[sparse.csr_array], observation: np.ndarray
    ) -> np.ndarray:
        """R[a, s] = sum_s' T sum_o Z R(a, s, s', o), row by row, over the successors that a row has."""
        num_actions, num_states, num_observations = observation.shape
        out = np.zeros((num_actions, num_states))
        wide: list[list[int]] = [[] for _ in range(num_actions)]  # entries of all states, by action
        single: dict[tuple[int, int], list[int]] = {}
        for number, (actions, states, *_) in enumerate(entries):
            for a in actions:
                if len(states) > 1 or num_states == 1:
                    wide[a].append(number)
                else:
                    single.setdefault((int(a), int(states[0])), []).append(number)
        for a in range(num_actions):
            for s in range(num_states):
                found = sorted(wide[a] + single.get((a, s), []))
                if found:
                    begin, end = transition[a].indptr[s : s + 2]
                    reached, chance = transition[a].indices[begin:end], transition[a].data[begin:end]
                    table = np.zeros((len(reached), num_observations))
                    for number in found:
                        _, _, after, seen, values = entries[number]
                        if after is None:
                            table[:] = values.reshape(num_states, num_observations)[reached]
                            continue
                        rows = slice(None) if len(after) == num_states else reached == after[0]
                        if seen is None:
                            table[rows] = values
                        elif len(seen) == num_observations:
                            table[rows] = values[0]
                        else:
                            table[rows, seen[0]] = values[0]
                    out[a, s] = self.sign * float(chance @ (observation[a][reached] * table).sum(axis=1))
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
