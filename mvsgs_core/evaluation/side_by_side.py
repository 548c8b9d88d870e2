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
from mvsgs_core.evaluation.common_frames import Times, different, one_input, same_keyframes, seconds_of, times_of
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
    reports = [run.report for run in runs]
    times = [times_of(cameras) for _, cameras in maps]
    shared, said = same_keyframes(reports, times), different(reports, times)
    common = sorted(shared[0])
    scores = [run.by_frame() for run in runs]
    of_common = [{i: found[k] for i, k in same.items() if k in found} for same, found in zip(shared, scores)]
    body = [
        f"<h1>{len(runs)} runs side by side</h1>",
        f'<div class="run">{html.figures_table(commands)}</div>',
        *([f'<p class="warning">{escape(said)}</p>'] if said else []),
        f"<h2>Figures, and what they are more than those of {escape(names[0])}</h2>",
        _table(names, figures, colored=not said),
        *_plots(runs, scores, times),
        "<h2>The same keyframes</h2>",
        *([] if common else ["<p>These runs have no keyframe in common.</p>"]),
    ]
    for index in chosen(common, of_common):
        body += _rows(runs, maps, scores, [same[index] for same in shared])
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


def _table(names: Sequence[str], figures: Sequence[Figure], *, colored: bool) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in ("", *names))
    rows = []
    for figure in figures:
        better = figure.better() if colored else [None] * len(names)
        classes = ({True: ' class="better"', False: ' class="worse"', None: ""}[found] for found in better)
        cells = "".join(f"<td{word}>{escape(cell)}</td>" for cell, word in zip(figure.cells(), classes))
        rows.append(f"<tr><td>{escape(figure.name)}</td>{cells}</tr>")
    return f'<table class="runs"><tr>{head}</tr>{"".join(rows)}</table>'


def _plots(runs: Sequence[Run], scores: Sequence[Mapping[int, float]], times: Sequence[Times]) -> list[str]:
    """By time, where it is known of all."""
    first, timed = metrics.IMAGE[0], all(len(of_run) > 1 for of_run in times)
    starts = [min(of_run.values(), default=0.0) for of_run in times]
    starts = [min(starts)] * len(runs) if one_input([run.report for run in runs]) else starts
    series = []
    for run, found, of_run, start in zip(runs, scores, times, starts):
        if found:
            x = np.array(sorted(found), dtype=float)
            y = np.array([found[index] for index in sorted(found)])
            series.append(svg.Series(run.name, seconds_of(x, of_run) - start if timed else x, y))
    if not series:
        return []
    drawn = svg.plot(series, "seconds of the stream" if timed else "frame", first.unit, width=480, height=300)
    return [f'<h2>Along the stream</h2><div style="max-width: 640px"><b>{first.label} of each frame</b>{drawn}</div>']


def _rows(
    runs: Sequence[Run], maps: Sequence[tuple[Snapshot, Cameras]], scores: Sequence[Mapping[int, float]],
    indices: Sequence[int],
) -> list[str]:  # fmt: skip
    """Renders of one keyframe, whose index each run has, and below each its error, or where no run kept the photograph
    its difference from the first. A run with other sizes has its own photograph, or no error."""
    first = metrics.IMAGE[0]
    renders = [render(final, cameras, index) for (final, cameras), index in zip(maps, indices)]
    said = [f"{run.name}: {first.text(of[index])}" for run, of, index in zip(runs, scores, indices) if index in of]
    which = f"keyframe {indices[0]}"
    if len(set(indices)) > 1:
        which = f"keyframe {', '.join(f'{index} of {run.name}' for run, index in zip(runs, indices))}"
    caption = which + (f": {first.label} {', '.join(said)}" if said else "")
    kept = [keyframe_images.known_image(run.folder / keyframe_images.FOLDER, k) for run, k in zip(runs, indices)]
    photographs = [image for image in kept if image is not None]
    word, lacking = "error", "no photograph of its size was kept"
    if not photographs:
        word, lacking = f"difference from {runs[0].name}", f"of another size than {runs[0].name}"
    errors = {}
    for run, picture, own in zip(runs, renders, kept):
        known = [image for image in (own, *(photographs or renders[:1])) if image is not None]
        against = next((image for image in known if image.shape == picture.shape), None)
        if against is None:
            errors[f"{run.name}, {lacking}"] = np.full_like(picture, 128)
        else:
            errors[f"{run.name}, {word} (x{_ERROR})"] = _error(picture, against)
    shown = {run.name: picture for run, picture in zip(runs, renders)}
    if photographs:
        shown = {"photograph": photographs[0], **shown}
    else:
        errors.pop(next(iter(errors)))  # the first's difference from itself
    above = html.Row(caption, _small(shown), columns=len(shown))
    below = html.Row("", _small(errors), columns=len(shown), empty=1)  # each error below its render
    return [html.row(above), html.row(below)]


def _error(picture: np.ndarray, against: np.ndarray) -> np.ndarray:
    """Of pictures (H, W, 3) uint8, the mean over the colors, as a report shows it."""
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
