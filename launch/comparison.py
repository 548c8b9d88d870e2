"""Runs side by side, from their report.json: the figures of each, and by how much they differ from the first's."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from launch.output import REPORT, read_report
from mvsgs_core.evaluation import metrics
from mvsgs_core.evaluation.common_frames import different, keyframe_times
from mvsgs_core.evaluation.metrics import Figure

PARTS = {  # where it is in the report -> how it is called
    **{place: m.label for place, m in metrics.COUNTS.items()},
    **{f"rendering.held_out.{m.key}": f"held-out {m.label}" for m in metrics.IMAGE},
    **{f"rendering.held_out_fitted.{m.key}": f"held-out, fitted {m.label}" for m in metrics.IMAGE[:1]},
    **{f"rendering.keyframes.{m.key}": f"keyframes {m.label}" for m in metrics.IMAGE[:1]},
    f"rendering.worst.all.{metrics.IMAGE[0].key}": f"worst frame {metrics.IMAGE[0].label}",
    **{f"trajectory.{m.key}": m.label for m in metrics.TRAJECTORY[:3]},
    **{f"depth.{m.key}": f"depth {m.label}" for m in metrics.DEPTH},
    **{
        place: m.name or m.label
        for place, m in metrics.RUN.items()
        if "*" not in place and place.partition(".")[0] != "rendering"
    },
}


def names(outputs: Sequence[Path]) -> list[str]:
    """What the runs are called: the parts of their folders' paths that not all of them share."""
    paths = [output.absolute() for output in outputs]
    if len(set(paths)) < 2:
        return [path.name for path in paths]
    common = Path(os.path.commonpath(paths))
    return [path.relative_to(common).as_posix() if path != common else path.name for path in paths]


def figures(reports: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Those that any of the runs has."""
    found = []
    for place, name in PARTS.items():
        values = [metrics.number(report, place) for report in reports]
        if any(value is not None for value in values):
            metric = metrics.at(place)
            found.append(Figure(f"{name}, {metric.unit}".removesuffix(", "), metric, values))
    return found


def compared(outputs: Sequence[Path]) -> list[list[str]]:
    """A table, its first row the heading: what is compared, then each run's figure, after the first with what it has
    more; figures that no run has are left out. Raises ValueError for a folder without a finished report."""
    rows = [[figure.name, *figure.cells()] for figure in figures([finished_report(output) for output in outputs])]
    return [["", *names(outputs)], *rows]


def comparison_page(outputs: Sequence[Path]) -> str:
    """The same as HTML, with renders of the same keyframes. Raises ValueError and OSError."""
    from mvsgs_core.evaluation.side_by_side import Run, page  # it renders, which the launcher else does not

    reports = [finished_report(output) for output in outputs]
    runs = [Run(name, output, report) for name, output, report in zip(names(outputs), outputs, reports)]
    return page(runs, figures(reports))


def comparison_text(outputs: Sequence[Path]) -> str:
    """The table for a terminal, and whether its figures compare. Raises ValueError as `compared` does, and OSError."""
    rows = compared(outputs)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        lines.append("  ".join(cells).rstrip())
    said = different([finished_report(output) for output in outputs], [keyframe_times(output) for output in outputs])
    lines += [f"warning: {said}"] if said else []
    return "\n".join(lines)


def has_figures(output: Path) -> bool:
    try:
        finished_report(output)
    except ValueError:
        return False
    return True


def finished_report(output: Path) -> dict[str, Any]:
    """report.json of a run that was scored. Raises ValueError, saying why there is none."""
    report = read_report(output)
    if not report:
        raise ValueError(f"{output}: no {REPORT} there; give the output folders of runs")
    if not report.get("finished", True) or "rendering" not in report:
        raise ValueError(f"{output}: that run has no figures: {report.get('reason') or 'no evaluator scored it'}")
    return report
