"""What the report shows of a run: renders beside photographs, depth maps, plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation import html, metrics, scoring, svg
from mvsgs_core.evaluation.evaluation import Evaluation
from mvsgs_core.evaluation.exposure import gains

Row = tuple[str, dict[str, np.ndarray]]


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
        rows.append((caption, scoring.comparison(finished.splats, finished.kernel, frames[score.index])))
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
    sheet = np.vstack([np.hstack(list(pictures.values())) for _, pictures in rows])
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
        size = (max(1, round(depth.shape[0] * 400 / depth.shape[1])), 400)
        shown = f"filtered depth{scoring.depth_scale(depth)}"
        pictures = {"photograph": evaluation.photograph(index), shown: scoring.colorize_depth(depth)}
        kept = 100 * float((depth > 0).mean())
        caption = f"keyframe {index}: {kept:.0f} % of the pixels kept"
        rows.append((caption, {n: resize_image(p, size) for n, p in pictures.items()}))
    return rows


def plots(evaluation: Evaluation, stages: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """SVG plots by title."""
    result = {}
    paths = evaluation.aligned_paths()
    if paths:
        # the two widest directions of the path, so that a plot from above needs no gravity
        everything = np.concatenate([p - p.mean(axis=0) for p in paths.values()])
        axes = np.linalg.svd(everything, full_matrices=False)[2][:2] if len(everything) > 1 else np.eye(3)[:2]
        center = next(iter(paths.values())).mean(axis=0)
        series = [svg.Series(name, *((p - center) @ axes.T).T) for name, p in paths.items()]
        unit = "unit of the true poses" if "truth" in paths else "the map's unit, which is arbitrary"
        result["Trajectory, in the plane of its two widest directions"] = svg.plot(
            series, f"first direction, {unit}", "second direction", equal=True
        )
    series, covered, first = [], [], metrics.IMAGE[0]
    for refined, name in ((False, "before refinement"), (True, "after")):
        scores = evaluation.scores.get(refined, [])
        if scores:
            index = np.array([s.index for s in scores], dtype=float)
            series.append(svg.Series(name, index, np.array([s.figures[first.key] for s in scores], dtype=float)))
            covered.append(svg.Series(name, index, np.array([100 * s.coverage for s in scores])))
    if series:
        result[f"{first.label} by frame"] = svg.plot(series, "frame", first.unit)
        result["Coverage by frame"] = svg.plot(covered, "frame", "% of the pixels more than half opaque")
    result |= _exposure_plot(evaluation)
    if stages:
        result["Time by stage"] = html.timing_bars(stages)
    return result


def _exposure_plot(evaluation: Evaluation) -> dict[str, str]:
    """Gain of red, green and blue of each frame of the map's part, where there is an exposure."""
    tracked, refined = evaluation.trajectory, True in evaluation.maps
    found = evaluation.exposures(refined) if evaluation.maps and tracked is not None else None
    if found is None or tracked is None:
        return {}
    main = tracked.main()
    x, y = tracked.index[main].astype(float), gains(found.affines)[main]
    series = [svg.Series(name, x, y[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    return {"Exposure by frame": svg.plot(series, "frame", "gain against the mean camera")}
