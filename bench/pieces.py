"""Runs in pieces: a long benchmark can be stopped, goes on where it was, and runs made at several times stand together.

Each piece is a Matrix in a folder of its own, or a file of what was measured. One that ended keeps what was asked for
and commit, machine and date: piece.json of a folder, FILE.asked of a file. With --resume the same command finds it and
runs only what is missing, failed or was asked for otherwise; without, everything is measured anew. Where a table holds
what was measured at another commit, on another machine or another day, its rows say so.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from bench.runs import ROOT, Matrix, Run, commit, missing_data
from bench.table import Origin, Row, as_json, is_failure, origin_rows, skipped
from mvsgs_core.atomic_file import replace_text

UNKNOWN = "unknown"  # machine and date of a piece that does not say them


class NotKept(Exception):
    """A file that only a measurement could make, where none may begin."""

    def __init__(self, file: Path) -> None:
        super().__init__(f"{file} is not measured yet")
        self.file = file


@dataclass
class Pieces:
    """A folder of pieces. `runs` may be called several times; `origins` and `missing` are about all of them."""

    output: Path
    resume: bool = False  # pieces that ended are read and not run again, whatever their commit
    collect: bool = False  # nothing is run: only what is there is read
    minutes: float | None = None  # no piece is started after so long; None: all are
    here: Origin = field(default_factory=Origin.here)  # of the pieces that run
    origins: list[Origin] = field(default_factory=list)  # of the pieces that there are
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
            if done is None and not self.may_start():
                self.missing.append(name)
                continue
            place = self.output / name
            if done is None:
                (place / "piece.json").unlink(missing_ok=True)
                done = asked(matrix) | asdict(replace(self.here, commit=commit(matrix.checkout)))
                (run or Matrix.run)(matrix, place)
                if all(made.report is not None for made in matrix.collect(place)):
                    (place / "piece.json").write_text(json.dumps(done, indent=1))
            found += matrix.collect(place)
            self.origins.append(_origin(done))
        return found

    @staticmethod
    def of(options: argparse.Namespace, output: Path, checkout: Path = ROOT) -> Pieces:
        """As the command line, with `arguments`, says. checkout: whose code runs."""
        return Pieces(output, options.resume, options.collect, options.minutes, Origin.here(checkout))

    def kept(self) -> Kept:
        """For files beside the runs: read and measured where pieces are, and their origins are among those of these."""
        return Kept(self.resume or self.collect, self.here, self.origins, self.may_start)

    def rows(self) -> list[Row]:
        """What must be said of how the runs were made; nothing where all are there and made here."""
        rows = origin_rows("runs", self.origins, self.here)
        if self.missing:
            rows.append(Row("not run yet (--resume goes on with them)", ", ".join(self.missing)))
        return rows

    @property
    def commits(self) -> list[str]:
        """Of the pieces that there are, each once."""
        return list(dict.fromkeys(origin.commit for origin in self.origins))

    def may_start(self) -> bool:
        """Whether anything may be measured."""
        late = self.minutes is not None and time.monotonic() - self._start > 60 * self.minutes
        return not self.collect and not late

    def _known(self, name: str, matrix: Matrix) -> dict[str, Any] | None:
        """What piece.json says, where that piece is one of this matrix."""
        file = self.output / name / "piece.json"
        if not (self.resume or self.collect) or not file.exists():
            return None
        done: dict[str, Any] = json.loads(file.read_text())
        return done if {key: done[key] for key in done.keys() - asdict(self.here)} == asked(matrix) else None


@dataclass
class Kept:
    """Files of what was measured, each with what was asked for beside it."""

    resume: bool
    here: Origin = field(default_factory=Origin.here)  # of what is measured
    origins: list[Origin] = field(default_factory=list)  # of the files that there are
    may_start: Callable[[], bool] = lambda: True  # whether anything may be measured

    def has(self, file: Path, asked: Any) -> bool:
        """Whether an earlier call left the file, and asked for the same: for what JSON can say.

        Raises NotKept where it did not and nothing may be measured.
        """
        beside = _asked_file(file)
        done = json.loads(beside.read_text()) if self.resume and file.exists() and beside.exists() else None
        if done is None or done["asked"] != json.loads(json.dumps(asked)):
            if not self.may_start():
                raise NotKept(file)
            beside.unlink(missing_ok=True)  # the file is about to be another
            return False
        self.origins.append(_origin(done))
        return True

    def keep(self, file: Path, asked: Any) -> None:
        """The file is made: a later call may take it."""
        replace_text(_asked_file(file), json.dumps({"asked": asked, **asdict(self.here)}, indent=1))
        self.origins.append(self.here)

    def rows(self, file: Path, asked: Any, measured: Callable[[], list[Row]]) -> list[Row]:
        """Rows that an earlier call left in the file, or that are measured now and, if nothing failed, left there."""
        if self.has(file, asked):
            return [Row(**row) for row in json.loads(file.read_text())]
        rows = measured()
        if not any(map(is_failure, rows)):
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_text(file, as_json(rows))
            self.keep(file, asked)
        return rows

    def origin(self) -> list[Row]:
        """What must be said of what was read: nothing where all was made here."""
        return origin_rows("results", self.origins, self.here)


def _origin(done: dict[str, str]) -> Origin:
    """As a piece says it."""
    return Origin(done["commit"], done.get("machine", UNKNOWN), done.get("date", UNKNOWN))


def _asked_file(file: Path) -> Path:
    return file.with_name(f"{file.name}.asked")


def with_data(scenes: Sequence[str]) -> tuple[list[str], list[Row]]:
    """The scenes whose data are on this machine, and a row for each that is left out."""
    missing = {scene: path for scene in scenes if (path := missing_data(scene)) is not None}
    rows = [skipped(scene, path) for scene, path in missing.items()]
    return [scene for scene in scenes if scene not in missing], rows


def in_pieces(
    scenes: Sequence[str], output: Path, resume: bool, minutes: float | None, measured: Callable[[str], list[Row]],
    asked: Any,
) -> list[Row]:  # fmt: skip
    """The rows of all scenes, of which those of another time are read where `resume`; each is kept as it ends.

    minutes: no scene is begun after; None: all are. asked: what else the rows of a scene depend on.
    """
    start, rows, kept, left = time.monotonic(), list[Row](), Kept(resume), list[str]()
    for name in scenes:
        file = output / f"{name}.json"
        late = minutes is not None and time.monotonic() - start > 60.0 * minutes
        if late and not kept.has(file, asked):
            left.append(name)
        else:
            rows += kept.rows(file, asked, partial(measured, name))
    rows += kept.origin()
    if left:
        rows.append(Row("not measured yet (--resume goes on with them)", ", ".join(left)))
    return rows


def arguments(parser: argparse.ArgumentParser, example: str, jobs: bool = False) -> None:
    """What the command line of a benchmark in pieces has for them, and the overrides of its runs."""
    if jobs:
        parser.add_argument("--jobs", type=int, default=1, help="runs at once; times mean little above 1")
    parser.add_argument("overrides", nargs="*", help=f"of every run: {example}")
    kept_arguments(parser, minutes=True)
    parser.add_argument("--collect", action="store_true", help="only read the runs that are in the folder")


def kept_arguments(parser: argparse.ArgumentParser, minutes: bool = False) -> None:
    """What the command line of a benchmark has that keeps what it measured. minutes: it can be told when to end."""
    parser.add_argument("--output", type=Path, help="folder of what is measured; default: in runs")
    parser.add_argument("--resume", action="store_true", help="keep what an earlier call of the same finished")
    if minutes:
        parser.add_argument("--minutes", type=float, help="start nothing more after; --resume goes on")


def asked(matrix: Matrix) -> dict[str, Any]:
    """What makes two pieces the same: everything but the folder. Times are others where several runs go at once."""
    return {
        "scenes": list(matrix.scenes),
        "variants": list(matrix.variants),
        "seeds": list(matrix.seeds),
        "overrides": list(matrix.overrides),
        "settings": [[setting.name, *setting.overrides] for setting in matrix.settings],
        **({} if matrix.jobs == 1 else {"jobs": matrix.jobs}),
        **({} if matrix.checkout == ROOT else {"checkout": str(matrix.checkout)}),
    }
