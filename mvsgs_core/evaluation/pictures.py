"""What the report shows of a run: renders beside photographs, depth maps, plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation import html, metrics, scoring, svg
from mvsgs_core.evaluation.evaluation import Evaluation
from mvsgs_core.evaluation.exposure import gains
from mvsgs_core.evaluation.ground_plane import ground_axes
from mvsgs_core.evaluation.html import Row

_plot = partial(svg.plot, width=480, height=300)  # so that its words can be read on a telephone
_SHEET = 400  # pixels of a picture's width in the sheet


def comparisons(evaluation: Evaluation) -> list[Row]:
    """Render beside photograph: the worst, median and best held-out frame, as far as there are as many, and the worst
    of all. Of all frames, where none is held out."""
    scores = evaluation.scores.get(True) or evaluation.scores.get(False) or []
    if not scores:
        return []
    refined = True in evaluation.maps
    finished = evaluation.maps[refined]
    frames = {frame.index: frame for frame in evaluation.scored_frames(refined)}
    rows = []
    for name, score in _picks(scores):
        figures = f"{metrics.listed(metrics.IMAGE, score.figures)}, {100 * score.coverage:.1f} % covered"
        caption = f"{name}: {score.index} ({score.kind}), {figures}"
        rows.append(Row(caption, *scoring.comparison(finished.splats, finished.kernel, frames[score.index])))
    return rows


def _picks(scores: Sequence[scoring.Score]) -> list[tuple[str, scoring.Score]]:
    """No frame twice."""
    held_out = [s for s in scores if s.held_out]
    among = "held-out frame" if held_out else "frame"
    ranked = sorted(held_out or scores, key=lambda s: s.rank)
    places = {"worst": 0, "median": len(ranked) // 2, "best": len(ranked) - 1}
    picks: dict[int, tuple[str, scoring.Score]] = {}
    for name, place in places.items():
        picks.setdefault(ranked[place].index, (f"{name} {among}", ranked[place]))
    if len(ranked) == 1:
        picks = {ranked[0].index: (f"only {among}", ranked[0])}
    worst = scoring.worst_of(scores)
    picks.setdefault(worst.index, (f"worst of all {len(scores)} frames scored", worst))
    return list(picks.values())


def write_sheet(file: Path, rows: list[Row]) -> None:
    """Writes the pictures of all rows, one below the other, as one PNG file."""
    sheet = np.vstack([np.hstack([_of_width(p, _SHEET) for p in row.pictures.values()]) for row in rows])
    if not cv2.imwrite(str(file), sheet[..., ::-1]):
        raise OSError(f"could not write {file}")


def depth_maps(evaluation: Evaluation, count: int = 3) -> list[Row]:
    """Filtered depth maps of keyframes spread over the run, beside the photographs."""
    available = evaluation.filtered_depths()
    rows = []
    for k in np.unique(np.linspace(0, len(available) - 1, count).round().astype(int)) if available else []:
        index = available[k]
        depth = evaluation.filtered_depth(index)
        assert depth is not None
        photograph = evaluation.photograph(index)
        width = min(640, photograph.shape[1])
        size = (max(1, round(depth.shape[0] * width / depth.shape[1])), width)
        colored = cv2.resize(scoring.colorize_depth(depth), size[::-1], interpolation=cv2.INTER_NEAREST)
        pictures = {"photograph": resize_image(photograph, size), "filtered depth": colored}
        kept = 100 * float((depth > 0).mean())
        caption = f"keyframe {index}: {kept:.0f} % of the pixels kept"
        rows.append(Row(caption, pictures, scoring.depth_range(depth)))
    return rows


def _of_width(picture: np.ndarray, width: int) -> np.ndarray:
    return resize_image(picture, (max(1, round(picture.shape[0] * width / picture.shape[1])), width))


def plots(evaluation: Evaluation, stages: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """SVG plots by title."""
    result = _from_above(evaluation)
    series, covered, first = [], [], metrics.IMAGE[0]
    for refined, name in ((False, "before refinement"), (True, "after")):
        scores = evaluation.scores.get(refined, [])
        if scores:
            index = np.array([s.index for s in scores], dtype=float)
            series.append(svg.Series(name, index, _ranking(scores)))
            covered.append(svg.Series(name, index, np.array([100 * s.coverage for s in scores])))
    if series:
        result[f"{first.label} by frame"] = _plot(series, "frame", first.unit)
        result["Coverage by frame"] = _plot(covered, "frame", "% of the pixels more than half opaque")
    result |= _exposure_plot(evaluation)
    if stages:
        result["Time by stage"] = html.timing_bars(stages)
    return result


def _ranking(scores: Sequence[scoring.Score]) -> np.ndarray:
    return np.array([score.figures[metrics.IMAGE[0].key] for score in scores], dtype=float)


def _from_above(evaluation: Evaluation) -> dict[str, str]:
    """The camera's path in the ground plane, and on it how well the finished map shows what was seen from there."""
    path = evaluation.aligned_path()
    if path is None:
        return {}
    axes, center = ground_axes(path.rotations), path.estimate.mean(axis=0)

    def plotted(series: list[svg.Series]) -> str:
        return _plot(series, f"right of the first view, {path.unit}", f"ahead, {path.unit}", equal=True)

    ways = {"estimate": path.estimate} if path.truth is None else {"truth": path.truth, "estimate": path.estimate}
    series = [svg.Series(name, *(axes @ (positions - center).T)) for name, positions in ways.items()]
    start = axes @ (path.estimate[:1] - center).T
    series.append(svg.Series("first frame", start[0], start[1], points=True))
    result = {"Trajectory from above, if the camera was held level": plotted(series)}
    if path.errors is not None:
        index, errors = path.known.astype(float), path.errors
        error = _plot([svg.Series("estimate", index, errors)], "frame", f"distance, {path.unit}")
        result["Error of the position by frame, after alignment"] = error
    scores = evaluation.scores.get(True) or evaluation.scores.get(False) or []
    shown = [score for score in scores if score.index in set(path.index.tolist())]
    if shown:
        place = {int(index): k for k, index in enumerate(path.index)}
        right, ahead = axes @ (path.estimate[[place[score.index] for score in shown]] - center).T
        first, covered = metrics.IMAGE[0], np.array([100 * score.coverage for score in shown])
        of_place = {
            f"{first.label} along the path": (first.unit, _ranking(shown)),
            "Coverage along the path": ("%", covered),
        }
        for title, (unit, values) in of_place.items():
            result[title] = plotted([svg.Series(unit, right, ahead, values=values)])
    return result


def _exposure_plot(evaluation: Evaluation) -> dict[str, str]:
    """Gain of red, green and blue of each frame of the map's part, where there is an exposure."""
    tracked, refined = evaluation.final_trajectory, True in evaluation.maps
    found = evaluation.exposures(refined) if evaluation.maps else None
    if found is None or tracked is None:
        return {}
    main = tracked.main(evaluation.maps[refined].keyframes)
    x, y = tracked.index[main].astype(float), gains(found)[main]
    series = [svg.Series(name, x, y[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    return {"Exposure by frame": _plot(series, "frame", "gain against the mean camera")}
