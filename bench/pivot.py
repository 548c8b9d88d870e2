"""Rows of a benchmark as Markdown: figures that several subjects have in common side by side, the others in a list.

A row's name is `subject: figure`, or `group: subject: figure`. Where at least three subjects have at least two figures
in common, these become tables of subjects against figures: one a group, turned so that they have fewer columns than
lines, cut so that none has more than eight. What a cell has no room for is told below in sentences.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from typing import Any

MIN_SUBJECTS = 3  # that share a figure before it becomes a column
MAX_COLUMNS = 8
MAX_CELL = 80  # characters of a text; what is longer becomes a paragraph
WIDTH = 118  # characters of a line outside tables

Row = dict[str, Any]


def markdown(rows: list[Row]) -> str:
    """Tables, the shared ones first, then the long texts; a value that misses its goal is bold."""
    long = [row for row in rows if isinstance(row["value"], str) and len(row["value"]) > MAX_CELL]
    parts, others = [], [row for row in rows if row not in long]
    while matrix := _shared(others):
        parts += _matrices(matrix)
        inside = {id(row) for figures in matrix.values() for row in figures.values()}
        others = [row for row in others if id(row) not in inside]
    parts += [_list(others)] if others else []
    parts += ["\n".join(_paragraph(row) for row in long)] if long else []
    if any(row["met"] is False for row in rows):
        parts.append("Bold: misses its goal.")
    return "\n\n".join(parts)


def number(value: float) -> str:
    if not math.isfinite(value):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def escape(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def value(row: Row, unit: str) -> str:
    """A row's value with its spread, as it stands in a cell."""
    found = row["value"]
    if found is None:
        return "–"
    if isinstance(found, str):
        return escape(f"{found} {unit}".strip())
    text = number(float(found))
    if row.get("spread") is not None:
        text += f" ± {number(float(row['spread']))}"
    return escape(f"{text} {unit}".strip())


def table(head: list[str], lines: list[list[str]], numbers: int | None = None) -> str:
    """`numbers`: so many columns after the first are set to the right; None: all."""
    right = len(head) - 1 if numbers is None else numbers
    rule = "|---|" + "---:|" * right + "---|" * (len(head) - 1 - right)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)])


def _shared(rows: list[Row]) -> dict[str, dict[str, Row]]:
    """subject -> figure -> row: the subjects of the figure that most have, and what enough of these share."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        subject, colon, figure = row["name"].rpartition(": ")
        if colon:
            found.setdefault(subject, {})[figure] = row
    for figure, times in Counter(figure for figures in found.values() for figure in figures).most_common():
        if times < MIN_SUBJECTS:
            break
        subjects = [subject for subject, figures in found.items() if figure in figures]
        among = Counter(other for subject in subjects for other in found[subject])
        shared = {other for other, count in among.items() if count >= MIN_SUBJECTS}
        if len(shared) >= 2:
            return {s: {other: row for other, row in found[s].items() if other in shared} for s in subjects}
    return {}


def _matrices(matrix: dict[str, dict[str, Row]]) -> list[str]:
    """A table a group of subjects, each under its name where there are several."""
    groups: dict[str, dict[str, dict[str, Row]]] = {}
    for subject, figures in matrix.items():
        group, _, rest = subject.rpartition(": ")
        groups.setdefault(group, {})[rest] = figures
    parts = []
    for group, subjects in groups.items():
        parts += [f"**{escape(group)}**"] if group else []
        parts += _matrix(subjects)
    return parts


def _matrix(matrix: dict[str, dict[str, Row]]) -> list[str]:
    figures = list(dict.fromkeys(figure for row in matrix.values() for figure in row))
    units = {f: _common([row[f]["unit"] for row in matrix.values() if f in row]) for f in figures}
    goals = {f: _common([row[f]["goal"] for row in matrix.values() if f in row]) for f in figures}
    titles = {
        f: escape(f + (f", {units[f]}" if units[f] else "") + (f" (goal {goals[f]})" if goals[f] else ""))
        for f in figures
    }

    def cell(subject: str, figure: str) -> str:
        row = matrix[subject].get(figure)
        if row is None:
            return ""
        text = value(row, row["unit"] if row["unit"] != units[figure] else "")
        if row["met"] is None:
            return text
        goal = f" (goal {escape(row['goal'])})" if row["goal"] != goals[figure] else ""
        return (text if row["met"] else f"**{text}**") + goal

    subjects = list(matrix)
    lines = [[cell(s, f) for f in figures] for s in subjects]
    if len(figures) <= len(subjects):
        return _cut([titles[f] for f in figures], [escape(s) for s in subjects], lines)
    turned = [list(column) for column in zip(*lines)]
    return _cut([escape(s) for s in subjects], [titles[f] for f in figures], turned)


def _cut(head: list[str], names: list[str], lines: list[list[str]]) -> list[str]:
    """As few tables as have at most MAX_COLUMNS columns, of even width, each without the lines that are empty in it."""
    pieces = math.ceil(len(head) / (MAX_COLUMNS - 1))
    width = math.ceil(len(head) / pieces)
    return [
        table(
            ["", *head[start : start + width]],
            [[name, *part] for name, line in zip(names, lines) if any(part := line[start : start + width])],
        )
        for start in range(0, len(head), width)
    ]


def _list(rows: list[Row]) -> str:
    goals = any(row["goal"] for row in rows)
    lines = []
    for row in rows:
        text = value(row, row["unit"])
        shown = f"**{text}**" if row["met"] is False else text
        lines.append([escape(row["name"]), shown, *([escape(row["goal"])] if goals else [])])
    return table(["", "value", *(["goal"] if goals else [])], lines)


def _paragraph(row: Row) -> str:
    text = f"- {escape(row['name'])}: {value(row, row['unit'])}"
    return textwrap.fill(text, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _common(texts: list[str]) -> str:
    """What more than half of them are, or nothing."""
    text, times = Counter(texts).most_common(1)[0]
    return text if 2 * times > len(texts) else ""
