"""Records a benchmark's rows, and writes what is read of them: docs/benchmarks/, BENCHMARKS.md's figures, README's.

    python -m bench.record NAME FILE.json [FILE.json ...] [--from FOLDER] [--command TEXT] [--note TEXT]
    python -m bench.record                    only writes the documents anew from what is recorded

Several files of the same rows are repeated runs: a figure becomes their mean, with half their range as its spread. The
record, bench/recorded/NAME.json, has a row a line, and keeps the command, and commit, machine and date of the
measurement, from FILE.json.origin. `--from`: the folder of the run, of which plots, *.svg, go to docs/benchmarks/. Rows
of which a document could not be made are refused, and nothing is changed. In docs/benchmarks/NAME.md what is between
`<!-- bench:NAME -->` and `<!-- /bench:NAME -->` is replaced by tables and plots; the words around it are written by
hand.
"""

from __future__ import annotations

import argparse
import json
import operator
import re
import shutil
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench import figures, pivot, plots
from bench.runs import ROOT, commit
from bench.table import is_skipped, origin_of
from mvsgs_core.machine import processor

RECORDED = ROOT / "bench" / "recorded"
PAGES = ROOT / "docs" / "benchmarks"
DOCUMENT = ROOT / "BENCHMARKS.md"
README = ROOT / "README.md"
_UNSET = {"unit": "", "goal": "", "met": None, "spread": None}  # of a row; not written
_BLOCK = re.compile(r"(<!-- bench:([\w/.-]+) -->\n).*?(<!-- /bench:\2 -->)", re.DOTALL)


@dataclass(frozen=True)
class Record:
    """Rows as in bench.table, each with `spread`: half the range, over the runs too where there are several."""

    name: str
    command: str
    commit: str
    machine: str
    date: str
    runs: int
    note: str = ""  # how it was made, where the command does not say
    rows: list[dict[str, Any]] = field(default_factory=list)
    plots: list[str] = field(default_factory=list)  # files in docs/benchmarks

    @staticmethod
    def load(name: str, folder: Path = RECORDED) -> Record:
        """Raises FileNotFoundError where nothing of that name is recorded."""
        found = json.loads((folder / f"{name}.json").read_text())
        return Record(**{**found, "rows": [{**_UNSET, **row} for row in found["rows"]]})

    def save(self, folder: Path = RECORDED) -> Path:
        """With a row a line, so that a difference of figures can be read."""
        file = folder / f"{self.name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        head = {key: value for key, value in asdict(self).items() if key != "rows"}
        keys = ("name", "value", *_UNSET)
        rows = [{k: row[k] for k in keys if k not in _UNSET or row.get(k, _UNSET[k]) != _UNSET[k]} for row in self.rows]
        lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
        text = json.dumps(head, indent=0, ensure_ascii=False)[:-2]
        file.write_text(f'{text},\n"rows": [\n{lines}\n]\n}}\n')
        return file

    def markdown(self) -> str:
        """Where it comes from, the tables, the plots."""
        repeated = f" {self.runs} runs." if self.runs > 1 else ""
        note = f" Made so: {self.note}." if self.note else ""
        origin = f"Recorded {self.date} at commit {self.commit} on {self.machine}.{repeated}{note} Command:"
        pictures = [f"![{Path(plot).stem.replace('_', ' ')}]({plot})" for plot in self.plots]
        command = textwrap.wrap(self.command, pivot.WIDTH - 2, break_long_words=False, break_on_hyphens=False)
        return "\n\n".join([
            textwrap.fill(origin, pivot.WIDTH, break_long_words=False, break_on_hyphens=False),
            "\n".join(["```", " \\\n  ".join(command), "```"]),
            pivot.markdown(self.rows),
            *pictures,
        ])  # fmt: skip


def merge(runs: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Rows of repeated runs as one list: means and spreads of numbers, none where a run has none, the last run's words;
    met if all runs met it. Raises ValueError for a run in which two rows have one name: they are two figures."""
    found: dict[str, list[dict[str, Any]]] = {}
    for rows in runs:
        if twice := [
            name for name, count in Counter(row["name"] for row in rows).items() if count > 1 and not is_skipped(name)
        ]:
            raise ValueError(f"several rows of one name: {'; '.join(twice)}")
        for row in rows:
            found.setdefault(row["name"], []).append(row)
    merged = []
    for same in found.values():
        values = [row["value"] for row in same]
        numbers = [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        row = {**same[-1], "spread": same[-1].get("spread")}
        if len(numbers) == len(values) > 1:
            spreads = [row.get("spread") or 0.0 for row in same]
            row["value"] = sum(numbers) / len(numbers)
            row["spread"] = (max(map(operator.add, numbers, spreads)) - min(map(operator.sub, numbers, spreads))) / 2
        elif None in values:
            row["value"] = row["spread"] = None
        met = [row["met"] for row in same if row["met"] is not None]
        row["met"] = all(met) if met else None
        merged.append(row)
    return merged


def render(text: str, folder: Path = RECORDED, new: Record | None = None) -> str:
    """A document with what is recorded in its blocks; a block of what is not says so. new: stands for the one of its
    name."""

    def block(match: re.Match[str]) -> str:
        name = match[2]
        if name in ("figures", "first"):
            body = figures.markdown(lambda of: loaded(of, folder, new).rows, first=name == "first")
        elif (new is not None and new.name == name) or (folder / f"{name}.json").exists():
            body = loaded(name, folder, new).markdown()
        else:
            body = "*Not recorded yet.*"
        return f"{match[1]}\n{body}\n\n{match[3]}"

    return _BLOCK.sub(block, text)


def loaded(name: str, folder: Path = RECORDED, new: Record | None = None) -> Record:
    """`new` where it is of that name, or what is recorded. Raises FileNotFoundError as `Record.load`."""
    return new if new is not None and new.name == name else Record.load(name, folder)


def documents() -> list[Path]:
    return [README, DOCUMENT, *sorted(PAGES.glob("*.md"))]


def read_rows(files: Iterable[Path]) -> list[list[dict[str, Any]]]:
    """Rows of each file; what is NaN or infinite there is None. Raises ValueError for a file that holds no rows."""
    runs = []
    for file in files:
        rows = json.loads(file.read_text(), parse_constant=lambda name: None)
        if not isinstance(rows, list) or not all(isinstance(r, dict) and {"name", "value"} <= set(r) for r in rows):
            raise ValueError(f"{file}: no rows of a benchmark; they are written with --json FILE")
        runs.append([{**_UNSET, **row} for row in rows])
    return runs


def origin(files: Iterable[Path]) -> tuple[dict[str, str], list[Path]]:
    """Commit, machine and date of what is in the files, all that there are of each, and the files that do not say it:
    for these it is now and here."""
    found: list[dict[str, str]] = []
    silent = []
    for file in files:
        beside = origin_of(file)
        if beside.exists():
            found.append(json.loads(beside.read_text()))
        else:
            silent.append(file)
            found.append({"commit": commit(), "machine": processor(), "date": time.strftime("%Y-%m-%d")})
    return {key: ", ".join(dict.fromkeys(one[key] for one in found)) for key in found[0]}, silent


def merged(name: str, files: list[Path], command: str, made_in: Path | None = None, note: str = "") -> Record:
    """The runs in `files` as one record, which is not saved. Raises ValueError as `merge`, and for rows of which the
    figures could not be made."""
    rows = merge(read_rows(files))
    if missing := figures.lacking(name, rows):
        raise ValueError(f"{name}: its record stays as it is, since these rows lack {'; '.join(missing)}")
    made, silent = origin(files)
    if silent:
        of_recording = f"commit, machine and date are those of recording {', '.join(file.name for file in silent)}"
        note = f"{note}; {of_recording}" if note else of_recording
    copied = [f"{name}_{plot.name}" for plot in _plots(made_in)]
    return Record(name, command, **made, runs=len(files), note=note, rows=rows, plots=copied)


def record(
    name: str, files: list[Path], command: str, made_in: Path | None = None, note: str = "", folder: Path = RECORDED,
    pages: Path = PAGES,
) -> Record:  # fmt: skip
    """Merges the runs in `files`, saves and returns the record. Raises ValueError as `merged`."""
    entry = merged(name, files, command, made_in, note)
    keep(entry, made_in, folder, pages)
    return entry


def keep(entry: Record, made_in: Path | None, folder: Path = RECORDED, pages: Path = PAGES) -> None:
    """Saves a record, and copies its plots from `made_in` to `pages`."""
    for plot, copy in zip(_plots(made_in), entry.plots):
        pages.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(plot, pages / copy)
    entry.save(folder)


def _plots(made_in: Path | None) -> list[Path]:
    return sorted(made_in.glob("*.svg")) if made_in else []


def run(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", help="such as transport, or quick/transport")
    parser.add_argument("files", nargs="*", type=Path, help="rows, from --json")
    parser.add_argument("--command", help="how they were made; default: python -m bench.NAME")
    parser.add_argument("--note", default="", help="what the reader must know besides: other work on the machine")
    parser.add_argument("--from", type=Path, dest="made_in", help="folder of the run, for *.svg")
    options = parser.parse_args(arguments)
    entry = None
    if options.name:
        if not options.files:
            parser.error(f"{options.name}: which files?")
        stem, quick = options.name.rpartition("/")[2], options.name.startswith("quick/")
        try:
            if all(is_skipped(row["name"]) for rows in read_rows(options.files) for row in rows):
                print(f"{options.name} measured nothing here: its record stays as it is")
                return 0
            command = options.command or f"python -m bench.{stem}" + (" --quick" if quick else "")
            entry = merged(options.name, options.files, command.strip(), options.made_in, options.note)
        except (OSError, ValueError) as error:
            print(error)
            return 1
    try:  # before anything is saved
        texts = {document: render(document.read_text(), new=entry) for document in documents()}
        drawn = figures.plots_of(lambda of: loaded(of, new=entry).rows)
    except (KeyError, ValueError) as error:
        print(f"no record and no document is changed: the figures cannot be made without {error}")
        return 1
    if entry is not None:
        keep(entry, options.made_in)
    for document, text in texts.items():
        document.write_text(text)
    for name, svg in drawn.items():
        plots.write(PAGES / f"{name}.svg", svg)
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
