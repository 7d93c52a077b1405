"""Cassandra's `.pomdp` file format: reading all of it, writing a sparse form of it.

Preamble `discount`, `values` (reward or cost), `states`, `actions`, `observations` (a number or names), `start`
(probabilities, uniform, one state, include, exclude); then `T`, `O` and `R` entries for single numbers, rows or
whole matrices, with `*` for all, `identity`, `uniform` and `reset` (to the start distribution). Later entries replace
earlier ones (planners.explicit.pomdp_entries). Rows that rounding in the file keeps from summing to 1 are scaled.
Source: A. Cassandra, "POMDP file format", pomdp.org, and the scanner and grammar of pomdp-solve. More is taken than
they take: docs/planners.md, "What the reader takes".
"""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from nesy.errors import UserError
from nesy.run_folder import atomic_path
from planners.explicit.pomdp_entries import Entries, expected_reward, transition_matrices
from planners.explicit.pomdp_tokens import LARGEST, NUMBER, Scanner, decoded

if TYPE_CHECKING:
    from planners.explicit.pomdp import TabularPOMDP

_KINDS = ("states", "actions", "observations")
_PREAMBLE = ("discount", "values", *_KINDS, "start")
_RESERVED = {*_PREAMBLE, *"TOR", "uniform", "identity", "reset", "reward", "cost", "include", "exclude"}
_ROUNDING = 1e-3  # how far a distribution may be from summing to 1
_MOST_NAMES = 1_000_000  # states, actions or observations that a file may count up

ESCAPED = "# names by nesy: _0xHH_ is the character of that code; n_0x_ at the beginning is nothing"
"""The line of a file some of whose names are escaped."""


def escape(name: str) -> str:
    """A name as a word that every reader of the format takes; different names stay different.

    Words that are names already stay as they are. Other characters, and underscores that would look like an escape,
    become `_0xHH_`; what does not begin with a letter then, or is a word of the format, gets `n_0x_` in front.
    """
    word = re.sub(r"[^A-Za-z0-9_-]|_(?=0x)", lambda found: f"_0x{ord(found[0]):x}_", name)
    return word if re.match(r"[A-Za-z]", word) and word not in _RESERVED else f"n_0x_{word}"


def unescape(word: str) -> str:
    """The name that `escape` made a word of."""
    return re.sub(
        r"_0x(10[0-9a-f]{4}|[0-9a-f]{1,5})_", lambda found: chr(int(found[1], 16)), word.removeprefix("n_0x_")
    )


def read(path: Path) -> dict[str, Any]:
    """Read a model: the arguments of `TabularPOMDP`.

    Raises:
        UserError: the file is missing, or a line is not understood; the message names the line.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error})") from None
    text = decoded(data)
    if text.lstrip().startswith("<"):
        raise UserError(f"{path}, line 1: this is XML (POMDPX?); only Cassandra's .pomdp format is read")
    return _Reader(text, str(path)).model()


class _Reader(Scanner):
    """What has been read of a file so far."""

    def __init__(self, text: str, name: str) -> None:
        super().__init__(text, name)
        self.escaped = bool(re.search(f"^{re.escape(ESCAPED)}$", text, re.MULTILINE))
        self.names: dict[str, list[str]] = {}
        self.places: dict[str, dict[str, int]] = {}
        self.discount, self.sign = 1.0, 1.0
        self.start: np.ndarray | None = None

    def at_heading(self) -> bool:
        """Whether a word and a colon come (or `start include:`)."""
        listed = self.peek() == "start" and self.peek(1) in ("include", "exclude") and self.peek(2) == ":"
        return self.peek(1) == ":" or listed

    def listed(self) -> list[str]:
        """The words before the next heading."""
        words = []
        while self.peek() is not None and not self.at_heading():
            if (word := self.take()) in (":", "*"):
                raise self.fail(f"expected a name, found '{word}'")
            words.append(word)
        return words

    def which(self, kind: str) -> int | None:
        """What a name or a number stands for; None for `*`."""
        token, places = self.take(), self.places[kind]
        if token in places:
            return places[token]
        if token == "*":
            return None
        if token.isdecimal() and int(token) < len(self.names[kind]):
            return int(token)
        if self.split(token):
            return self.which(kind)
        raise self.fail(f"unknown {kind[:-1]} '{token}'")

    def model(self) -> dict[str, Any]:
        self.preamble()
        sizes = [len(self.names[kind]) for kind in _KINDS]
        num_states, num_actions, num_observations = sizes
        if num_actions * num_states * num_observations > LARGEST:
            raise UserError(f"{self.name}: {num_states} states and {num_observations} observations are too many")
        transitions = Entries((num_actions, num_states, num_states))
        rewards = Entries((num_actions, num_states, num_states, num_observations))
        observation = np.zeros((num_actions, num_states, num_observations))
        while self.peek() is not None:
            keyword = self.take()
            if keyword == "R":
                self.reward_entry(rewards)
            elif keyword == "T":
                self.transition_entry(transitions)
            elif keyword == "O":
                self.observation_entry(observation)
            else:
                raise self.fail(f"expected 'T:', 'O:' or 'R:', found '{keyword}'")
        states, actions, observations = (
            tuple(map(unescape, self.names[kind]) if self.escaped else self.names[kind]) for kind in _KINDS
        )
        matrices = transition_matrices(transitions, actions, states, self.name)
        sums = observation.sum(axis=2, keepdims=True)
        observation = np.where(np.abs(sums - 1) <= _ROUNDING, observation / np.where(sums > 0, sums, 1.0), observation)
        reward = self.sign * expected_reward(rewards, matrices, observation) + 0.0
        stays = np.all([m.diagonal() > 1 - 1e-12 for m in matrices], axis=0)
        assert self.start is not None
        return {
            "states": states,
            "actions": actions,
            "observations": observations,
            "transition": matrices,
            "observation": observation,
            "reward": reward,
            "discount": self.discount,
            "start": self.start / self.start.sum() if abs(self.start.sum() - 1) <= _ROUNDING else self.start,
            "terminal": stays & (reward == 0).all(axis=0),
        }

    def preamble(self) -> None:
        given = set()
        while (keyword := self.peek()) is not None and keyword not in ("T", "O", "R"):
            self.take()
            if keyword not in _PREAMBLE:
                close = difflib.get_close_matches(keyword.lower(), _PREAMBLE, 1)
                hint = f"did you mean '{close[0]}:'?" if close else f"it takes {', '.join(_PREAMBLE)}"
                raise self.fail(f"unknown word '{keyword}' in the preamble; {hint}")
            if keyword in given:
                raise self.fail(f"'{keyword}:' is there twice")
            given.add(keyword)
            self.preamble_entry(keyword)
        for kind in _KINDS:
            if kind not in self.names:
                raise self.fail(f"the preamble lacks '{kind}:'")
        if self.start is None:
            self.start = np.full(len(self.names["states"]), 1.0 / len(self.names["states"]))

    def preamble_entry(self, keyword: str) -> None:
        chosen = self.take() if keyword == "start" and self.peek() in ("include", "exclude") else None
        self.colon()
        if keyword == "discount":
            self.discount = self.number()
        elif keyword == "values":
            kind = self.take()
            if kind not in ("reward", "rewards", "cost", "costs"):
                raise self.fail(f"values are 'reward' or 'cost', not '{kind}'")
            self.sign = 1.0 if kind.startswith("reward") else -1.0
        elif keyword == "start":
            if "states" not in self.names:
                raise self.fail("'start' comes before 'states:'")
            self.start = self.start_among(chosen) if chosen else self.start_belief()
        else:
            words = self.listed()
            if len(words) == 1 and words[0].isdecimal():
                if int(words[0][:9]) > _MOST_NAMES or len(words[0]) > 9:
                    raise self.fail(f"{words[0]} {keyword} are too many")
                words = [str(i) for i in range(int(words[0]))]
            if not words:
                raise self.fail(f"'{keyword}:' names nothing; at least one is needed")
            if len(set(words)) != len(words):
                raise self.fail(f"a name occurs twice in '{keyword}:'")
            self.names[keyword] = words
            self.places[keyword] = {word: i for i, word in enumerate(words)}

    def start_among(self, chosen: str) -> np.ndarray:
        """`start include:` and `start exclude:`: uniform over the states listed, or over the others."""
        listed = np.zeros(len(self.names["states"]), np.bool_)
        while self.peek() is not None and not self.at_heading():
            state = self.which("states")
            listed[slice(None) if state is None else state] = True
        mask = listed if chosen == "include" else ~listed
        if not mask.any():
            raise self.fail("no state is left to start in")
        return np.asarray(mask / mask.sum())

    def start_belief(self) -> np.ndarray:
        """`start:` with a state, `uniform` or a probability for every state."""
        count = len(self.names["states"])
        words = self.listed()
        if words == ["uniform"]:
            return np.full(count, 1.0 / count)
        if len(words) == 1 and (words[0] in self.places["states"] or (words[0].isdecimal() and int(words[0]) < count)):
            return np.eye(1, count, self.places["states"].get(words[0], int(words[0]) if words[0].isdecimal() else 0))[
                0
            ]
        wrong = next((word for word in words if not NUMBER.fullmatch(word)), None)
        if len(words) == count and wrong is None:
            return np.array(words, np.float64)
        found = f"{len(words)} numbers" if wrong is None else f"'{wrong}'"
        raise self.fail(
            f"'start:' takes a state, 'uniform' or a probability for each of the {count} states, found {found}; "
            "several states are listed after 'start include:'"
        )

    def transition_entry(self, entries: Entries) -> None:
        self.colon()
        action, count = self.which("actions"), len(self.names["states"])
        if self.peek() != ":":
            self.transition_block(entries, (action,), (count, count))
            return
        self.colon()
        state = self.which("states")
        if self.peek() != ":":
            self.transition_block(entries, (action, state), (count,))
            return
        self.colon()
        entries.put((action, state, self.which("states")), self.value())

    def transition_block(self, entries: Entries, where: tuple[int | None, ...], shape: tuple[int, ...]) -> None:
        """A row or a matrix of transitions, or the word for one."""
        word, every = self.peek(), np.arange(shape[-1])
        if word in ("uniform", "reset") or (word == "identity" and len(shape) == 2):
            self.take()
        whole = (*where, *[None] * (2 - len(where)))
        if word == "uniform":
            entries.put((*whole, None), 1.0 / shape[-1])
        elif word == "reset":
            assert self.start is not None
            begins = np.flatnonzero(self.start)
            entries.put_block(whole, (begins,), self.start[begins])
        elif word == "identity" and len(shape) == 2:
            entries.put_block(where, (every, every), np.ones(len(every)))
        else:
            block = self.numbers(int(np.prod(shape))).reshape(shape)
            cells = np.nonzero(block)
            entries.put_block(where, cells, block[cells])

    def observation_entry(self, table: np.ndarray) -> None:
        """One probability, a row or a matrix of observations, straight into the table [A, S, O]."""
        self.colon()
        where: list[int | slice] = []
        for kind in ("actions", "states", "observations"):
            if where:
                self.colon()
            place = self.which(kind)
            where.append(slice(None) if place is None else place)
            if self.peek() != ":" or len(where) == 3:
                break
        shape = table.shape[len(where) :]
        if not shape:
            table[tuple(where)] = self.value()
        elif self.peek() == "uniform":
            self.take()
            table[tuple(where)] = 1.0 / shape[-1]
        else:
            table[tuple(where)] = self.numbers(int(np.prod(shape))).reshape(shape)

    def reward_entry(self, entries: Entries) -> None:
        self.colon()
        where: list[int | None] = []
        for kind in ("actions", "states", "states", "observations"):
            if where:
                self.colon()
            where.append(self.which(kind))
            if len(where) > 1 and self.peek() != ":":
                break
        shape = (len(self.names["states"]), len(self.names["observations"]))[len(where) - 2 :]
        if not shape:
            entries.put(where, self.value())
            return
        block = self.numbers(int(np.prod(shape))).reshape(shape)
        cells = np.nonzero(block)
        entries.put_block(where, cells, block[cells])

    def value(self) -> float:
        """The number of an entry; some files have a colon before it."""
        if self.peek() == ":":
            self.colon()
        return self.number()


def write(model: TabularPOMDP, path: Path) -> None:
    """Write a model with its non-zero entries; `read` gives its names back, other readers see them escaped."""
    lines = [f"discount: {float(model.discount)!r}", "values: reward"]
    for kind in _KINDS:
        names = list(getattr(model, kind))
        words = list(map(escape, names))
        if names == [str(i) for i in range(len(names))]:
            words = [str(len(names))]
        elif words != names and lines[0] != ESCAPED:
            lines.insert(0, ESCAPED)
        lines.append(f"{kind}: {' '.join(words)}")
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
