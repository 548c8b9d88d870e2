"""The ten figures and the two plots of BENCHMARKS.md: each of ours beside its baseline, from what is recorded.

The first of them stand in README.md, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench import pivot
from mvsgs_core.evaluation import svg

Rows = Callable[[str], list[dict[str, Any]]]  # those recorded of a benchmark, by its name; FileNotFoundError


@dataclass(frozen=True)
class Figure:
    """Two rows of one record, side by side. {ours} and {theirs}: the images of both, from the record's protocol;
    {kept}: the share of the true depths that both keep."""

    what: str
    benchmark: str
    ours: str  # name of the row
    baseline: str  # what it is
    theirs: str  # name of its row
    first: bool = False  # among those that a newcomer sees

    @property
    def rows(self) -> list[str]:
        """Names of the rows that it is made of; what both had stands in the last, where `what` or `baseline` say it."""
        text, name = self.what + self.baseline, self.ours
        if "{kept}" in text:
            return [name, self.theirs, name.removesuffix("inliers") + "completeness"]
        return [name, self.theirs, *([f"{name.partition(':')[0]}: protocol"] if "{" in text else [])]


_REDKITCHEN, _FR1 = "RedKitchen, {ours}", "freiburg1_xyz, {ours}"
_COLMAP, _OFFLINE = "COLMAP, same frames at {theirs}", "COLMAP at {theirs} + offline splatting, equal optimization time"
_PROTOCOL = re.compile(r"(\d+ frames at \d+x\d+), .*COLMAP got \d+ of the frames at (\d+x\d+)")
FIGURES = (
    Figure(f"Position error, {_REDKITCHEN}, of the path", "baselines",
           "redkitchen: poses, ours: ATE, frames that COLMAP has", _COLMAP,
           "redkitchen: poses, COLMAP: ATE, frames that COLMAP has"),
    Figure(f"Position error, {_FR1}, of the path", "baselines",
           "tum_fr1_xyz: poses, ours: ATE, frames that COLMAP has", _COLMAP,
           "tum_fr1_xyz: poses, COLMAP: ATE, frames that COLMAP has"),
    Figure(f"Processor time to poses, {_REDKITCHEN}", "baselines",
           "redkitchen: poses, ours: seconds", _COLMAP, "redkitchen: poses, COLMAP: seconds"),
    Figure("Depth of the room, true poses: kept pixels within 2 %, at {kept} of completeness", "depth",
           "room, 320x240: inliers", "plane sweep of OpenCV's parts",
           "room: plane sweep inliers, as complete as filtered"),
    Figure("Depth of RedKitchen, tracked poses: kept pixels within 5 %, at {kept} of completeness", "depth",
           "redkitchen, tracked, 320x240: inliers", "plane sweep of OpenCV's parts",
           "redkitchen, tracked: plane sweep inliers, as complete as filtered"),
    Figure(f"Processor time from frames to map, {_REDKITCHEN}", "baselines",
           "redkitchen: map, ours: seconds, frames to map", _OFFLINE,
           "redkitchen: map, COLMAP + splatting, equal time: seconds, frames to map", first=True),
    Figure(f"Held-out PSNR, {_REDKITCHEN}", "baselines",
           "redkitchen: map, ours: held-out PSNR", _OFFLINE,
           "redkitchen: map, COLMAP + splatting, equal time: held-out PSNR", first=True),
    Figure(f"Held-out PSNR, {_FR1}", "baselines",
           "tum_fr1_xyz: map, ours: held-out PSNR", _OFFLINE,
           "tum_fr1_xyz: map, COLMAP + splatting, equal time: held-out PSNR", first=True),
    Figure("Rasterizer, 640x480, 50,000 Gaussians, both ways", "rasterizer",
           "640x480 50k gaussian: both", "roofline of the machine", "640x480 50k gaussian: roofline"),
    Figure("Transport of a 640x480 image, median", "transport",
           "ipc, VGA RGB (0.9 MB): latency, median", "plain pyzmq",
           "ipc, VGA RGB (0.9 MB): latency, median, plain pyzmq"),
)  # fmt: skip


def lacking(benchmark: str, rows: list[dict[str, Any]]) -> list[str]:
    """Names of the rows of a benchmark that the figures need and that are not among these."""
    needed = [name for figure in FIGURES if figure.benchmark == benchmark for name in figure.rows]
    return sorted(set(needed) - {row["name"] for row in rows})


def markdown(rows: Rows, first: bool = False) -> str:
    """A table of all, or of the first ones.

    Raises FileNotFoundError where a benchmark is not recorded, KeyError where its record lacks a row, and ValueError
    where it does not say what images both had.
    """
    lines = []
    for figure in (figure for figure in FIGURES if figure.first or not first):
        found = {row["name"]: row for row in rows(figure.benchmark)}
        row, other, *shared = (found[name] for name in figure.rows)
        ours, theirs = (pivot.value(one, one["unit"]) for one in (row, other))
        what, baseline = figure.what, figure.baseline
        if shared:
            what, baseline = (text.format(**_words(shared[0])) for text in (what, baseline))
        page = f"[`python -m bench.{figure.benchmark}`](docs/benchmarks/{figure.benchmark}.md)"
        lines.append([what, f"**{ours}**", theirs, baseline, page])
    return pivot.table(["", "ours", "baseline", "which is", "printed by"], lines, numbers=2)


def _words(row: dict[str, Any]) -> dict[str, str]:
    """What a row says of both sides, by the word that stands for it. Raises ValueError where it says nothing."""
    if isinstance(row["value"], float):
        return {"kept": f"{row['value']:.2f}"}
    images = _PROTOCOL.match(row["value"] or "")
    if images is None:
        raise ValueError(f"{row['name']}: {row['value']!r} does not say what images both had")
    return {"ours": images[1], "theirs": images[2]}


def plots_of(rows: Rows) -> dict[str, str]:
    """SVG by name: position errors over COLMAP's, and held-out PSNR over the time to the map."""
    ratio = ": ATE / pycolmap's, same frames"
    errors = {
        row["name"].removesuffix(ratio): float(row["value"])
        for row in rows("tracking")
        if row["name"].endswith(ratio) and isinstance(row["value"], float)
    }
    found: dict[str, dict[str, dict[str, float]]] = {}  # way: method: figure
    for row in rows("baselines"):
        scene, kind, *rest = row["name"].split(": ")
        if kind.startswith("map, ") and rest:
            way = f"{scene}, {kind.removeprefix('map, ').partition(',')[0]}"
            found.setdefault(way, {}).setdefault(kind, {})[rest[0]] = row["value"]
    series = [
        svg.Series(
            way,
            np.array([figures["seconds, frames to map"] for figures in methods.values()], np.float64),
            np.array([figures["held-out PSNR"] for figures in methods.values()], np.float64),
            points=True,
        )
        for way, methods in found.items()
    ]
    return {
        "poses": svg.bars(dict(sorted(errors.items(), key=lambda entry: entry[1])), "x"),
        "maps": svg.plot(series, "seconds from frames to map", "held-out PSNR, dB", width=640),
    }
