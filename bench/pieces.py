"""Runs in pieces: a long benchmark can be stopped, goes on where it was, and runs made at several times stand together.

Each piece is a Matrix in a folder of its own. One that ended keeps piece.json: what was asked for, and the commit. With
--resume the same command finds it and runs only what is missing; without, everything is measured anew.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.runs import ROOT, Matrix, Run, commit
from bench.table import Row


@dataclass
class Pieces:
    """A folder of pieces. `runs` may be called several times; `commits` and `missing` are about all of them."""

    output: Path
    resume: bool = False  # pieces that ended are read and not run again, whatever their commit
    collect: bool = False  # nothing is run: only what is there is read
    minutes: float | None = None  # no piece is started after so long; None: all are
    commits: list[str] = field(default_factory=list)  # of the pieces that were read, each once
    missing: list[str] = field(default_factory=list)  # names of the pieces that did not run
    _start: float = field(default_factory=time.monotonic)

    def runs(self, matrices: dict[str, Matrix], run: Callable[[Matrix, Path], object] | None = None) -> list[Run]:
        """The runs of all matrices, by name of the piece, in their order; those of missing pieces are left out.

        run: runs a matrix in a folder, to watch it, in place of Matrix.run.
        Raises ValueError for an unknown scene or variant, before anything runs.
        """
        for matrix in matrices.values():
            matrix.check()
        found: list[Run] = []
        for name, matrix in matrices.items():
            done = self._known(name, matrix)
            if done is None and not self._may_start:
                self.missing.append(name)
                continue
            place = self.output / name
            if done is None:
                (place / "piece.json").unlink(missing_ok=True)
                (run or Matrix.run)(matrix, place)
                done = {**asked(matrix), "commit": commit(matrix.checkout)}
                (place / "piece.json").write_text(json.dumps(done, indent=1))
            found += matrix.collect(place)
            if done["commit"] not in self.commits:
                self.commits.append(done["commit"])
        return found

    @staticmethod
    def of(options: argparse.Namespace, output: Path) -> Pieces:
        """As the command line, with `arguments`, says."""
        return Pieces(output, options.resume, options.collect, options.minutes)

    def rows(self) -> list[Row]:
        """What must be said of how the runs were made; nothing where all are there and of one commit."""
        rows = []
        if len(self.commits) > 1:
            rows.append(Row("runs of the commits", ", ".join(self.commits)))
        if self.missing:
            rows.append(Row("not run yet (--resume goes on with them)", ", ".join(self.missing)))
        return rows

    @property
    def _may_start(self) -> bool:
        late = self.minutes is not None and time.monotonic() - self._start > 60 * self.minutes
        return not self.collect and not late

    def _known(self, name: str, matrix: Matrix) -> dict[str, Any] | None:
        """What piece.json says, where that piece is one of this matrix."""
        file = self.output / name / "piece.json"
        if not (self.resume or self.collect) or not file.exists():
            return None
        done: dict[str, Any] = json.loads(file.read_text())
        return done if {key: done.get(key) for key in asked(matrix)} == asked(matrix) else None


def arguments(parser: argparse.ArgumentParser, example: str, jobs: bool = False) -> None:
    """What the command line of a benchmark in pieces has for them, and the overrides of its runs."""
    if jobs:
        parser.add_argument("--jobs", type=int, default=1, help="runs at once; times mean little above 1")
    parser.add_argument("overrides", nargs="*", help=f"of every run: {example}")
    parser.add_argument("--output", type=Path, help="folder of the runs; default: in runs")
    parser.add_argument("--resume", action="store_true", help="keep the runs of an earlier call that it finished")
    parser.add_argument("--minutes", type=float, help="start no more runs after; --resume goes on")
    parser.add_argument("--collect", action="store_true", help="only read the runs that are in the folder")


def asked(matrix: Matrix) -> dict[str, Any]:
    """What makes two pieces the same: everything but the folder and how many runs went at once."""
    return {
        "scenes": list(matrix.scenes),
        "variants": list(matrix.variants),
        "seeds": list(matrix.seeds),
        "overrides": list(matrix.overrides),
        "settings": [[setting.name, *setting.overrides] for setting in matrix.settings],
        **({} if matrix.checkout == ROOT else {"checkout": str(matrix.checkout)}),
    }
