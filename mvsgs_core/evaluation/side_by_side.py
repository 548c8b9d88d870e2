"""Runs side by side as one self-contained page: their figures, errors along the stream, the same keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation import html, metrics, svg
from mvsgs_core.evaluation.metrics import Figure
from mvsgs_core.evaluation.scoring import colorize
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras, read_cameras
from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.export.ply import read_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.interface import as_bytes

SHOWN = 3  # keyframes that all runs have, besides that in which they differ most
_WIDTH = 640  # pixels of a picture at most
_ERROR = 4  # by which errors are brightened, as in a report


@dataclass(frozen=True)
class Run:
    """One of them."""

    name: str
    folder: Path
    report: Mapping[str, Any]

    def by_frame(self) -> dict[int, float]:
        """The first image metric of the frames that were scored, by index."""
        key, frames = metrics.IMAGE[0].key, self.report.get("rendering", {}).get("frames") or []
        return {int(frame["index"]): float(frame[key]) for frame in frames if frame.get(key) is not None}


def page(runs: Sequence[Run], figures: Sequence[Figure]) -> str:
    """The document. Raises ValueError and OSError where a run's map cannot be read."""
    names = [run.name for run in runs]
    commands = {run.name: str((run.report.get("run") or {}).get("command") or run.folder) for run in runs}
    maps = [_map_of(run.folder) for run in runs]
    common = sorted(set.intersection(*(set(cameras.keyframes.tolist()) for _, cameras in maps)))
    scores = [run.by_frame() for run in runs]
    body = [
        f"<h1>{len(runs)} runs side by side</h1>",
        f'<div class="run">{html.figures_table(commands)}</div>',
        f"<h2>Figures, and what they are more than those of {escape(names[0])}</h2>",
        _table(names, figures),
        *_plots(runs, scores),
        "<h2>The same keyframes</h2>",
        *([] if common else ["<p>These runs have no keyframe in common.</p>"]),
    ]
    for index in chosen(common, scores):
        body += _rows(runs, maps, scores, index)
    return html.document(f"Comparison of {', '.join(names)}", body)


def chosen(common: Sequence[int], scores: Sequence[Mapping[int, float]]) -> list[int]:
    """Of the keyframes that all have some spread over the stream, and the one in which the runs differ most."""
    places = np.linspace(0, len(common) - 1, min(SHOWN, len(common))).round().astype(int)
    found = {common[place] for place in places.tolist()}
    scored = [index for index in common if all(index in of_run for of_run in scores)]
    if scored:
        found.add(max(scored, key=lambda index: float(np.ptp([of_run[index] for of_run in scores]))))
    return sorted(found)


def _map_of(folder: Path) -> tuple[Snapshot, Cameras]:
    """Raises ValueError, saying what to do, where a run left none."""
    files = folder / "map.ply", folder / "cameras.json"
    if missing := [file.name for file in files if not file.is_file()]:
        raise ValueError(
            f"{folder}: {' and '.join(missing)} is missing, from which keyframes are rendered: the run wrote no map "
            "(as with mapper=frozen), or it was removed; without --html the figures alone are compared"
        )
    return read_ply(files[0]), read_cameras(files[1])


def _table(names: Sequence[str], figures: Sequence[Figure]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in ("", *names))
    rows = []
    for figure in figures:
        classes = ({True: ' class="better"', False: ' class="worse"', None: ""}[found] for found in figure.better())
        cells = "".join(f"<td{word}>{escape(cell)}</td>" for cell, word in zip(figure.cells(), classes))
        rows.append(f"<tr><td>{escape(figure.name)}</td>{cells}</tr>")
    return f'<table class="runs"><tr>{head}</tr>{"".join(rows)}</table>'


def _plots(runs: Sequence[Run], scores: Sequence[Mapping[int, float]]) -> list[str]:
    first = metrics.IMAGE[0]
    series = [
        svg.Series(run.name, np.array(sorted(found), dtype=float), np.array([found[index] for index in sorted(found)]))
        for run, found in zip(runs, scores)
        if found
    ]
    if not series:
        return []
    drawn = svg.plot(series, "frame", first.unit, width=480, height=300)
    return ["<h2>Along the stream</h2>", f'<div style="max-width: 640px"><b>{first.label} by frame</b>{drawn}</div>']


def _rows(
    runs: Sequence[Run], maps: Sequence[tuple[Snapshot, Cameras]], scores: Sequence[Mapping[int, float]], index: int
) -> list[str]:
    """Renders of one keyframe, and below each its error, or where no run kept the photograph its difference from the
    first."""
    first = metrics.IMAGE[0]
    renders = {run.name: render(final, cameras, index) for run, (final, cameras) in zip(runs, maps)}
    said = [f"{run.name}: {first.text(found[index])}" for run, found in zip(runs, scores) if index in found]
    caption = f"keyframe {index}" + (f": {first.label} {', '.join(said)}" if said else "")
    kept = (keyframe_images.known_image(run.folder / keyframe_images.FOLDER, index) for run in runs)
    photograph = next((image for image in kept if image is not None), None)
    against = next(iter(renders.values())) if photograph is None else photograph
    word = f"difference from {runs[0].name}" if photograph is None else "error"
    errors = {f"{name}, {word} (x{_ERROR})": _error(picture, against) for name, picture in renders.items()}
    if photograph is None:
        errors.pop(next(iter(errors)))
    shown = renders if photograph is None else {"photograph": photograph, **renders}
    above = html.Row(caption, _small(shown), columns=len(shown))
    below = html.Row("", _small(errors), columns=len(shown), empty=1)  # each error below its render
    return [html.row(above), html.row(below)]


def _error(picture: np.ndarray, against: np.ndarray) -> np.ndarray:
    """Of pictures (H, W, 3) uint8, the mean over the colors, as a report shows it."""
    if picture.shape != against.shape:
        against = resize_image(against, (picture.shape[0], picture.shape[1]))
    error = np.abs(picture.astype(np.float32) - against.astype(np.float32)).mean(axis=2) / 255.0
    return colorize(np.clip(_ERROR * error, 0.0, 1.0))


def _small(pictures: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    small = {}
    for name, picture in pictures.items():
        width = min(_WIDTH, picture.shape[1])
        small[name] = resize_image(picture, (max(1, round(picture.shape[0] * width / picture.shape[1])), width))
    return small


def render(final: Snapshot, cameras: Cameras, index: int) -> np.ndarray:
    """(H, W, 3) uint8 of a keyframe, in its photograph's exposure."""
    k = cameras.keyframes.tolist().index(index)
    return as_bytes(rendered_keyframe(final, cameras, k)[0])


__all__ = ["Run", "chosen", "page", "render"]
