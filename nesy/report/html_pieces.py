"""Pieces of HTML that the sections of the report are made of."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence
from typing import Any

from nesy.report.text import TEXT_COLUMNS, flat, number

SHORT_CAPTION = 90
"""Letters of a caption that may be wider than its table; a longer one is broken into lines."""


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], caption: str, text_columns: int = 1) -> str:
    """A table; its first `text_columns` columns and `TEXT_COLUMNS` are text, the others numbers. All is escaped."""

    def cells(tag: str, values: Sequence[str]) -> str:
        kinds = [
            "" if position < text_columns or column in TEXT_COLUMNS else ' class="number"'
            for position, column in enumerate(columns)
        ]
        return "".join(f"<{tag}{kind}>{html.escape(value)}</{tag}>" for kind, value in zip(kinds, values, strict=True))

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    length = ' class="short"' if len(caption) <= SHORT_CAPTION else ""
    return (
        f'<div class="scroll"><table><caption{length}>{html.escape(caption)}</caption>'
        f"<thead><tr>{cells('th', columns)}</tr></thead><tbody>\n{body}\n</tbody></table></div>"
    )


def figure(svg: str, caption: str, label: str) -> str:
    """A picture from inline SVG, with its caption and a label for screen readers."""
    return (
        f'<figure><div class="plot" role="img" aria-label="{html.escape(label)}">{svg}</div>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def figures_table(values: dict[str, Any], caption: str) -> str:
    """Nested figures of summary.json, one row each."""
    return table(("figure", "value"), [(name, number(value)) for name, value in flat(values)], caption)


def embedded_json(identifier: str, value: Any) -> str:
    """Data for the page's scripts: JSON in an element that is never run.

    Every character with which markup could begin or end is written as an escape of JSON, so that no text of a run
    can leave the element.

    Args:
        identifier: the element's id.
        value: JSON values, without NaN and infinities.
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return f'<script type="application/json" id="{html.escape(identifier)}">{text}</script>'
