"""What every benchmark shares: rows, a table on the screen, `--json FILE`, `--quick`, names on its command line.

FILE gets the rows, with null for a number that is not finite, which JSON does not have, and FILE.origin beside it
commit, machine and date of the measurement, which `bench.record` keeps: those of this call, or where results of other
calls were read, those that the rows of `origin_rows` name.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.table import Table

from bench.runs import ROOT, commit
from mvsgs_core.machine import processor

T = TypeVar("T")
REPORT = "a report"  # goal of a run: without one there is nothing to measure
SKIPPED = ": skipped"  # how the name of a row ends that says what is left out
_PARTS = {"commits": "commit", "machines": "machine", "dates": "date"}  # of an origin, by what its rows call them
_ORIGIN = re.compile(rf"(?:runs|results) of the ({'|'.join(_PARTS)})")  # a row of `origin_rows` about all of a table


@dataclass(frozen=True)
class Origin:
    """Where something was measured."""

    commit: str
    machine: str
    date: str

    @staticmethod
    def here(checkout: Path = ROOT) -> Origin:
        return Origin(commit(checkout), processor(), time.strftime("%Y-%m-%d"))


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
    """No value meets a limit that is not finite, as of a run that failed; NaN meets none."""
    return Row(name, value, unit, f"<= {limit:g}", bool(value <= limit < math.inf))


def at_least(name: str, value: float, unit: str, limit: float) -> Row:
    """As `at_most`."""
    return Row(name, value, unit, f">= {limit:g}", bool(value >= limit > -math.inf))


def all_of(name: str, met: int, runs: int) -> Row:
    """How many of so many runs did what all should."""
    return Row(name, f"{met} of {runs}", "", f"{runs} of {runs}", met == runs)


def failed(name: str, why: str) -> Row:
    """A run that left no report; the benchmark ends with exit code 1."""
    return Row(name, why, "", REPORT, False)


def is_failure(row: Row) -> bool:
    return row.goal == REPORT and row.met is False


def skipped(name: str, why: Path | str) -> Row:
    """What is left out, said. why: the path that is missing, or a sentence."""
    return Row(f"{name}{SKIPPED}", f"{why} is missing" if isinstance(why, Path) else why)


def is_skipped(name: str) -> bool:
    """Whether a row of this name is one of `skipped`."""
    return name.endswith(SKIPPED)


def origin_rows(what: str, origins: Sequence[Origin], here: Origin) -> list[Row]:
    """What must be said of what was measured in several calls, or in another: commits, machines and dates.

    what: "runs" or "results". Nothing is said of what is all as it is here.
    """
    rows = []
    for plural, part in _PARTS.items():
        found = list(dict.fromkeys(getattr(origin, part) for origin in origins))
        if found and found != [getattr(here, part)]:
            rows.append(Row(f"{what} of the {plural}", ", ".join(found)))
    return rows


def timed(
    name: str, values: Sequence[float], unit: str, maximum: float | None = None, minimum: float | None = None
) -> Row:
    """The median of repeated measurements with their spread. A goal is met where all of them meet it.

    values: one a round; what is compared runs in turns within each round, so that whatever else the machine does meets
    both. Of the goals `maximum` and `minimum` at most one is given. NaN among them: the figure is NaN, and no goal met.
    """
    known = not any(map(math.isnan, values))  # neither orders nor limits hold for NaN
    value = statistics.median(values) if known else math.nan
    spread = (max(values) - min(values)) / 2 if known else math.nan
    if maximum is not None:
        met = known and max(values) <= maximum
        return Row(name, value, unit, f"<= {maximum:g}, all of {len(values)}", met, spread)
    if minimum is not None:
        met = known and min(values) >= minimum
        return Row(name, value, unit, f">= {minimum:g}, all of {len(values)}", met, spread)
    return Row(name, value, unit, spread=spread)


def checked(convert: Callable[[str], T]) -> Callable[[str], T]:
    """A type of an argument: the ValueErrors of `convert` are said with the usage."""

    def converted(text: str) -> T:
        try:
            return convert(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return converted


def names(known: Iterable[str], separator: str = ",") -> Callable[[str], list[str]]:
    """A type of an argument: one of the known names or several."""
    there = list(known)

    def listed(text: str) -> list[str]:
        found = text.split(separator)
        if unknown := [name for name in found if name not in there]:
            raise ValueError(f"no {', '.join(map(repr, unknown))}; there are: {f'{separator} '.join(there)}")
        return found

    return checked(listed)


@checked
def numbers(text: str) -> list[int]:
    """A type of an argument: 0,1,2."""
    if not all(part.isdecimal() for part in text.split(",")):
        raise ValueError(f"{text!r} must be numbers such as 0,1,2")
    return [int(part) for part in text.split(",")]


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
    """Command line of a benchmark: measures, prints the table, writes the rows. Exits with 1 where a run failed."""
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--quick", action="store_true", help="a smaller run that ends within a minute")
    parser.add_argument("--json", type=Path, help="write the rows as JSON")
    if arguments:
        arguments(parser)
    options = parser.parse_args()
    made = asdict(Origin.here())  # of what runs from here on
    if options.json:
        try:
            _try_to_write(options.json)
        except OSError as error:
            parser.error(f"--json {options.json}: {error.strerror}")
    rows = measure(options)
    show(rows, title)
    if options.json:
        options.json.write_text(as_json(rows))
        said = {_PARTS[of[1]]: row.value for row in rows if (of := _ORIGIN.fullmatch(row.name))}
        origin_of(options.json).write_text(json.dumps(made | said, indent=1))
    if any(map(is_failure, rows)):
        sys.exit(1)


def as_json(rows: Iterable[Row]) -> str:
    """Of a file of rows: a value or spread that is not finite is null."""
    return json.dumps([{key: _finite(value) for key, value in asdict(row).items()} for row in rows], indent=1)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def origin_of(file: Path) -> Path:
    """Where commit, machine and date of a file of rows are."""
    return file.with_name(f"{file.name}.origin")


def _try_to_write(file: Path) -> None:
    """Raises OSError where nothing can be written there: a measurement takes hours and would be lost at its end."""
    file.parent.mkdir(parents=True, exist_ok=True)
    new = not file.exists()
    file.open("a").close()
    if new:
        file.unlink()
