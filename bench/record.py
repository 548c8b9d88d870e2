"""Records a benchmark's rows and puts them into BENCHMARKS.md.

    python -m bench.record NAME FILE.json [FILE.json ...] [--from FOLDER] [--command TEXT]
    python -m bench.record                    only writes BENCHMARKS.md anew from what is recorded

Several files of the same rows are repeated runs: a figure becomes their mean, with half their range as its spread. The
record, bench/recorded/NAME.json, keeps command, commit, machine and date. `--from`: the folder of a benchmark that also
writes a table of its own form, table.md, and plots, *.svg: they take the place of the plain table. In BENCHMARKS.md the
text between `<!-- bench:NAME -->` and `<!-- /bench:NAME -->` is replaced by all this; everything else stays.
"""

from __future__ import annotations

import argparse
import json
import operator
import re
import shutil
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench import pivot
from bench.runs import ROOT, commit, machine

RECORDED = ROOT / "bench" / "recorded"
DOCUMENT = ROOT / "BENCHMARKS.md"
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
    rows: list[dict[str, Any]] = field(default_factory=list)
    table: str = ""  # Markdown, in place of the plain table of the rows
    plots: list[str] = field(default_factory=list)  # files beside the record

    @staticmethod
    def load(name: str, folder: Path = RECORDED) -> Record:
        """Raises FileNotFoundError where nothing of that name is recorded."""
        return Record(**json.loads((folder / f"{name}.json").read_text()))

    def save(self, folder: Path = RECORDED) -> Path:
        file = folder / f"{self.name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n")
        return file

    def markdown(self) -> str:
        """Where it comes from, the table, the plots."""
        repeated = f", {self.runs} runs" if self.runs > 1 else ""
        origin = f"`{self.command}`{repeated}; commit {self.commit}; {self.machine}; {self.date}"
        folder = RECORDED.relative_to(ROOT)
        plots = [f"![{plot}]({folder}/{plot})" for plot in self.plots]
        return "\n\n".join([origin, self.table.strip() or pivot.markdown(self.rows), *plots])


def merge(runs: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Rows of repeated runs as one list: means and spreads of numbers, the last run's words; met if all runs met it."""
    found: dict[str, list[dict[str, Any]]] = {}
    for rows in runs:
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
        met = [row["met"] for row in same if row["met"] is not None]
        row["met"] = all(met) if met else None
        merged.append(row)
    return merged


def render(text: str, folder: Path = RECORDED) -> str:
    """BENCHMARKS.md with the tables of everything that is recorded; a table of what is not says so."""

    def block(match: re.Match[str]) -> str:
        name = match[2]
        if (folder / f"{name}.json").exists():
            body = Record.load(name, folder).markdown()
        else:
            body = "*Not recorded yet.*"
        return f"{match[1]}\n{body}\n\n{match[3]}"

    return _BLOCK.sub(block, text)


def read_rows(files: Iterable[Path]) -> list[list[dict[str, Any]]]:
    """Rows of each file. Raises ValueError for a file that holds no rows."""
    runs = []
    for file in files:
        rows = json.loads(file.read_text())
        if not isinstance(rows, list) or not all(isinstance(r, dict) and {"name", "value"} <= set(r) for r in rows):
            raise ValueError(f"{file}: no rows of a benchmark; they are written with --json FILE")
        runs.append([{"unit": "", "goal": "", "met": None, **row} for row in rows])
    return runs


def record(name: str, files: list[Path], command: str, made_in: Path | None = None, folder: Path = RECORDED) -> Record:
    """Merges the runs in `files`, takes table.md and *.svg from `made_in`, saves and returns the record."""
    rows = merge(read_rows(files))
    table, plots = "", []
    if made_in is not None:
        own = made_in / "table.md"
        table = own.read_text() if own.exists() else ""
        for plot in sorted(made_in.glob("*.svg")):
            plots.append(f"{name}_{plot.name}")
            (folder / plots[-1]).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(plot, folder / plots[-1])
    entry = Record(name, command, commit(), machine(), time.strftime("%Y-%m-%d"), len(files), rows, table, plots)
    entry.save(folder)
    return entry


def run(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", help="such as transport, or quick/transport")
    parser.add_argument("files", nargs="*", type=Path, help="rows, from --json")
    parser.add_argument("--command", help="how they were made; default: python -m bench.NAME")
    parser.add_argument("--from", type=Path, dest="made_in", help="folder of the run, for table.md and *.svg")
    options = parser.parse_args(arguments)
    if options.name:
        if not options.files:
            parser.error(f"{options.name}: which files?")
        stem, quick = options.name.rpartition("/")[2], options.name.startswith("quick/")
        if not any(read_rows(options.files)):
            print(f"{options.name} measured nothing here: its record stays as it is")
            return 0
        command = options.command or f"python -m bench.{stem}" + (" --quick" if quick else "")
        record(options.name, options.files, command.strip(), options.made_in)
    if DOCUMENT.exists():
        DOCUMENT.write_text(render(DOCUMENT.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
