"""What every benchmark shares: rows, a table on the screen, `--json FILE`, `--quick`."""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One measured figure. `goal` is text such as "<= 1.5"; `met` is None where there is no goal."""

    name: str
    value: float | str | None
    unit: str = ""
    goal: str = ""
    met: bool | None = None
    spread: float | None = None  # half the range of repeated measurements; None: measured once


def at_most(name: str, value: float, unit: str, limit: float) -> Row:
    return Row(name, value, unit, f"<= {limit:g}", bool(value <= limit))


def at_least(name: str, value: float, unit: str, limit: float) -> Row:
    return Row(name, value, unit, f">= {limit:g}", bool(value >= limit))


def all_of(name: str, met: int, runs: int) -> Row:
    """How many of so many runs did what all should."""
    return Row(name, f"{met} of {runs}", "", f"{runs} of {runs}", met == runs)


def timed(
    name: str, values: Sequence[float], unit: str, maximum: float | None = None, minimum: float | None = None
) -> Row:
    """The median of repeated measurements with their spread. A goal is met where all of them meet it.

    values: one a round; what is compared runs in turns within each round, so that whatever else the machine does meets
    both. Of the goals `maximum` and `minimum` at most one is given.
    """
    value, spread = statistics.median(values), (max(values) - min(values)) / 2
    if maximum is not None:
        return Row(name, value, unit, f"<= {maximum:g}, all of {len(values)}", max(values) <= maximum, spread)
    if minimum is not None:
        return Row(name, value, unit, f">= {minimum:g}, all of {len(values)}", min(values) >= minimum, spread)
    return Row(name, value, unit, spread=spread)


def show(rows: list[Row], title: str) -> None:
    table = Table(title=title)
    for column in ("name", "value", "unit", "goal", "met"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for row in rows:
        value = f"{row.value:.4g}" if isinstance(row.value, float) else str(row.value)
        value += "" if row.spread is None else f" ± {row.spread:.2g}"
        table.add_row(row.name, value, row.unit, row.goal, {True: "yes", False: "NO", None: ""}[row.met])
    Console(width=140).print(table)


def main(
    measure: Callable[[argparse.Namespace], list[Row]],
    title: str,
    arguments: Callable[[argparse.ArgumentParser], None] | None = None,
) -> None:
    """Command line of a benchmark: measures, prints the table, writes the JSON rows."""
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--quick", action="store_true", help="a smaller run that ends within a minute")
    parser.add_argument("--json", type=Path, help="write the rows as JSON")
    if arguments:
        arguments(parser)
    options = parser.parse_args()
    rows = measure(options)
    show(rows, title)
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
