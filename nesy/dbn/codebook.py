"""The codebook: the distinct views met in experience, their codes, how often each was met, and what holds there.

It is the observation model of the symbolic state (a view has one code) and, with the truth of the domain's
predicates on every view, all that a question about meaning needs: no network and no domain is loaded.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nesy.checked_arrays import integers
from nesy.dbn import storage
from nesy.dbn.rows import code_type, unique_rows
from nesy.errors import UserError

if TYPE_CHECKING:
    from domains.core import PredicateVocabulary

FORMAT = "nesy-codebook"


@dataclass(frozen=True, eq=False)
class Codebook:
    """Distinct views with their codes."""

    views: np.ndarray
    """uint8 [V, v, v]: the views, indexed [vx, vy]."""
    codes: np.ndarray
    """[V, N]: the code of each view; uint8 where no factor has more than 256 values."""
    counts: np.ndarray
    """int64 [V]: how often each view was met."""
    predicates: np.ndarray
    """bool [V, P]: what holds in each view."""
    predicate_names: tuple[str, ...] = ()
    """P names."""
    predicate_meanings: tuple[str, ...] = ()
    """P texts."""
    cell_kinds: tuple[str, ...] = ("empty", "wall", "goal", "unseen")
    """What the numbers in a view stand for."""

    def __post_init__(self) -> None:
        number = len(self.views)
        if self.views.ndim != 3 or self.codes.ndim != 2 or self.predicates.ndim != 2:
            raise UserError("a codebook has views [V, v, v], codes [V, N] and predicates [V, P]")
        if not len(self.codes) == len(self.counts) == len(self.predicates) == number:
            raise UserError("the columns of a codebook must be of one length")
        if not self.predicates.shape[1] == len(self.predicate_names) == len(self.predicate_meanings):
            raise UserError("a codebook has one name and one meaning per predicate")
        if self.views.size and self.views.max() >= len(self.cell_kinds):
            raise UserError(f"a view holds a cell kind beyond {len(self.cell_kinds) - 1}")

    @classmethod
    def build(
        cls, views: np.ndarray, codes: np.ndarray, counts: np.ndarray, vocabulary: PredicateVocabulary | None
    ) -> Codebook:
        """Make a codebook, with the truth of every predicate of `vocabulary` on every view.

        Args:
            views: [V, v, v], whole numbers below 256: the kind of every cell.
            codes: [V, N].
            counts: [V].
            vocabulary: names the predicates; None for none.

        Raises:
            UserError: other numbers, or columns of different lengths.
        """
        views = integers(views, "views of a codebook", (None, None, None), 256).astype(np.uint8, copy=False)
        codes = integers(codes, "codes of a codebook", (len(views), None))
        names = tuple(vocabulary.names) if vocabulary is not None else ()
        truth = (
            np.asarray(vocabulary.evaluate(views), dtype=bool)
            if vocabulary is not None
            else np.zeros((len(views), 0), dtype=bool)
        )
        meanings = tuple(vocabulary.meanings.get(name, "") for name in names) if vocabulary is not None else ()
        return cls(
            views=views,
            codes=codes.astype(code_type(int(codes.max(initial=0)) + 1), copy=False),
            counts=integers(counts, "counts of a codebook", (len(views),)).astype(np.int64, copy=False),
            predicates=truth,
            predicate_names=names,
            predicate_meanings=meanings,
        )

    def __len__(self) -> int:
        return len(self.views)

    def predicate(self, name: str) -> np.ndarray:
        """Truth bool [V] of one predicate on every view.

        Raises:
            UserError: there is no such predicate.
        """
        if name not in self.predicate_names:
            close = difflib.get_close_matches(name, self.predicate_names, n=3, cutoff=0.5) or self.predicate_names[:3]
            raise UserError(
                f"no predicate '{name}'; there are {len(self.predicate_names)}, among them {', '.join(close)} "
                "(all of them: nesy query --vocabulary)"
            )
        return np.asarray(self.predicates[:, self.predicate_names.index(name)])

    def distinct_codes(self) -> tuple[np.ndarray, np.ndarray]:
        """The distinct codes uint8 [C, N], and for every view the index of its code, int64 [V]."""
        codes, index = np.unique(self.codes, axis=0, return_inverse=True)
        return codes, index.reshape(-1)

    def save(self, folder: Path | str) -> None:
        """Write codebook.json and codebook.npz into `folder`."""
        document: dict[str, Any] = {
            "format": FORMAT,
            "version": 1,
            "predicate_names": list(self.predicate_names),
            "predicate_meanings": list(self.predicate_meanings),
            "cell_kinds": list(self.cell_kinds),
        }
        arrays = {
            "views": self.views,
            "codes": self.codes,
            "counts": self.counts,
            "predicates": self.predicates,
        }
        storage.save(Path(folder), "codebook", "codebook", document, arrays)

    @classmethod
    def load(cls, folder: Path | str) -> Codebook:
        """Read a codebook from `folder`.

        Raises:
            UserError: a file is missing or damaged.
        """
        document, arrays = storage.load(Path(folder), "codebook", FORMAT)
        path = Path(folder) / "codebook.json"
        try:
            return cls(
                views=_typed(arrays["views"], np.uint8),
                codes=_typed(arrays["codes"], np.unsignedinteger),
                counts=_typed(arrays["counts"], np.int64),
                predicates=_typed(arrays["predicates"], np.bool_),
                predicate_names=tuple(str(name) for name in document["predicate_names"]),
                predicate_meanings=tuple(str(text) for text in document["predicate_meanings"]),
                cell_kinds=tuple(str(kind) for kind in document["cell_kinds"]),
            )
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}: does not describe a codebook ({error!r})") from None


def _typed(array: np.ndarray, dtype: type[np.generic]) -> np.ndarray:
    if not np.issubdtype(array.dtype, dtype):
        raise ValueError(f"expected {dtype.__name__}, found {array.dtype}")
    return array


def distinct_views(views: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The distinct views, for every view the index of its own, and how often each occurs.

    Args:
        views: uint8 [n, v, v].

    Returns:
        uint8 [V, v, v] in lexicographic order, int64 [n], int64 [V].
    """
    first, index, counts = unique_rows(views.reshape(len(views), -1))
    return views[first], index, counts


def value_meanings(codebook: Codebook, num_values: int, most: int = 3) -> tuple[tuple[str, ...], ...]:
    """What each value of each factor means, in a few predicates.

    Of the distinct views with the value, the predicates that hold (or fail) in at least 95 % of them and
    in clearly fewer of all views, the most telling first; the one most telling predicate with its share
    where there is none such.

    Returns:
        [N][K] texts; `not met` for a value that no view has.
    """
    base = codebook.predicates.mean(axis=0) if len(codebook) else np.zeros(len(codebook.predicate_names))
    return tuple(
        tuple(_meaning(codebook, codebook.codes[:, factor] == value, base, most) for value in range(num_values))
        for factor in range(codebook.codes.shape[1])
    )


def named_meanings(
    meanings: tuple[tuple[str, ...], ...], readability: Mapping[str, Any]
) -> tuple[tuple[str, ...], ...]:
    """The meanings, with those of factors that were made to answer questions said by their answers.

    Args:
        meanings: [N][K] texts, as `value_meanings` finds them.
        readability: readability.json of a world model; `named`: {factor: {questions, answers: {value: [bool]}}}.

    Raises:
        UserError: it is damaged.
    """
    result = [list(texts) for texts in meanings]
    try:
        for factor, named in dict(readability.get("named") or {}).items():
            for value, answers in named["answers"].items():
                if result[int(factor)][int(value)] != "not met":
                    told = zip(named["questions"], answers, strict=True)
                    result[int(factor)][int(value)] = ", ".join(str(q) if yes else f"not {q}" for q, yes in told)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise UserError(f"readability.json does not say what values of factors mean ({error!r}); train again") from None
    return tuple(tuple(texts) for texts in result)


def _meaning(codebook: Codebook, chosen: np.ndarray, base: np.ndarray, most: int) -> str:
    if not chosen.any():
        return "not met"
    if not len(base):
        return f"{int(chosen.sum())} views"
    share = codebook.predicates[chosen].mean(axis=0)
    lift = share - base
    ranked = np.argsort(-np.abs(lift), kind="stable")
    sure = [p for p in ranked if abs(lift[p]) >= 0.1 and (share[p] >= 0.95 or share[p] <= 0.05)]
    if sure:
        names = codebook.predicate_names
        return ", ".join(names[p] if share[p] > 0.5 else f"not {names[p]}" for p in sure[:most])
    best = ranked[0]
    return f"{codebook.predicate_names[best]} in {100 * share[best]:.0f} % (of all views {100 * base[best]:.0f} %)"
