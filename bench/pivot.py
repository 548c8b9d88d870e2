"""Rows of a benchmark as Markdown: figures that several subjects have in common side by side, the others in a list.

A row's name is `subject: figure`. Where at least three subjects have at least two figures in common, these become a
table of subjects against figures, turned so that it has fewer columns than lines.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

MIN_SUBJECTS = 3  # that share a figure before it becomes a column

Row = dict[str, Any]


def markdown(rows: list[Row]) -> str:
    """Tables, the shared ones first; a value that misses its goal is bold, and so it says below."""
    parts, others = [], rows
    while matrix := _shared(others):
        parts.append(_matrix(matrix))
        inside = {id(row) for figures in matrix.values() for row in figures.values()}
        others = [row for row in others if id(row) not in inside]
    parts += [_list(others)] if others else []
    if any(row["met"] is False for row in rows):
        parts.append("Bold: misses its goal.")
    return "\n\n".join(parts)


def number(value: float) -> str:
    if not math.isfinite(value):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def escape(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _shared(rows: list[Row]) -> dict[str, dict[str, Row]]:
    """subject -> figure -> row: the subjects of the figure that most have, and what enough of these share."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        subject, colon, figure = row["name"].partition(": ")
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


def _matrix(matrix: dict[str, dict[str, Row]]) -> str:
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
        text = _value(row, row["unit"] if row["unit"] != units[figure] else "")
        if row["met"] is None:
            return text
        goal = f" (goal {escape(row['goal'])})" if row["goal"] != goals[figure] else ""
        return (text if row["met"] else f"**{text}**") + goal

    subjects = list(matrix)
    if len(figures) <= len(subjects):
        return _table(
            ["", *(titles[f] for f in figures)], [[escape(s), *(cell(s, f) for f in figures)] for s in subjects]
        )
    return _table(["", *map(escape, subjects)], [[titles[f], *(cell(s, f) for s in subjects)] for f in figures])


def _list(rows: list[Row]) -> str:
    goals = any(row["goal"] for row in rows)
    lines = []
    for row in rows:
        text = _value(row, row["unit"])
        missed = row["met"] is False
        lines.append(
            [escape(row["name"]), f"**{text}**" if missed else text, *([escape(row["goal"])] if goals else [])]
        )
    return _table(["", "value", *(["goal"] if goals else [])], lines)


def _table(head: list[str], lines: list[list[str]]) -> str:
    rule = "|---|" + "---:|" * (len(head) - 1)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)])


def _common(texts: list[str]) -> str:
    """What more than half of them are, or nothing."""
    text, times = Counter(texts).most_common(1)[0]
    return text if 2 * times > len(texts) else ""


def _value(row: Row, unit: str) -> str:
    value = row["value"]
    if value is None:
        return "–"
    if isinstance(value, str):
        return escape(f"{value} {unit}".strip())
    text = number(float(value))
    if row.get("spread") is not None:
        text += f" ± {number(float(row['spread']))}"
    return escape(f"{text} {unit}".strip())
