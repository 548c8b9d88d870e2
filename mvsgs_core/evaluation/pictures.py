"""What the report shows of a run: renders beside photographs, depth maps, plots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation import html, scoring, svg
from mvsgs_core.evaluation.evaluation import Evaluation
from mvsgs_core.held_out import is_held_out

Row = tuple[str, dict[str, np.ndarray]]


def comparisons(evaluation: Evaluation) -> list[Row]:
    """Render beside photograph: the worst, median and best held-out frame (keyframes where none is held out)."""
    scores = evaluation.scores.get(True) or evaluation.scores.get(False) or []
    held_out = [s for s in scores if not s.keyframe and is_held_out(s.index)] or scores
    if not held_out:
        return []
    refined = True in evaluation.maps
    finished = evaluation.maps[refined]
    views = {v.index: v for v in evaluation.views(refined)}
    ranked = sorted(held_out, key=lambda s: s.psnr)
    picks = {"worst": ranked[0], "median": ranked[len(ranked) // 2], "best": ranked[-1]}
    rows = []
    for name, score in picks.items():
        kind = "keyframe" if score.keyframe else "held-out"
        caption = f"{name} {kind} frame {score.index}: {score.psnr:.2f} dB, SSIM {score.ssim:.3f}"
        rows.append((caption, scoring.comparison(finished.splats, finished.density, views[score.index])))
    return rows


def write_sheet(file: Path, rows: list[Row]) -> None:
    """Writes the pictures of all rows, one below the other, as one PNG file."""
    sheet = np.vstack([np.hstack(list(pictures.values())) for _, pictures in rows])
    if not cv2.imwrite(str(file), sheet[..., ::-1]):
        raise OSError(f"could not write {file}")


def depth_maps(evaluation: Evaluation, count: int = 3) -> list[Row]:
    """Filtered depth maps of keyframes spread over the run, beside the photographs."""
    if evaluation.track is None:
        return []
    indices = [int(i) for i in evaluation.track.index[evaluation.track.keyframe]]
    available = [i for i in indices if evaluation.filtered_depth(i) is not None]
    rows = []
    for k in np.unique(np.linspace(0, len(available) - 1, count).round().astype(int)) if available else []:
        index = available[k]
        depth = evaluation.filtered_depth(index)
        assert depth is not None
        size = (max(1, round(depth.shape[0] * 400 / depth.shape[1])), 400)
        pictures = {"photograph": evaluation.photograph(index), "filtered depth": scoring.colorize_depth(depth)}
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
        result["Trajectory"] = svg.plot(series, "widest direction", "second", equal=True)
    series = []
    for refined, name in ((False, "before refinement"), (True, "after")):
        scores = evaluation.scores.get(refined, [])
        if scores:
            index = np.array([s.index for s in scores], dtype=float)
            series.append(svg.Series(name, index, np.array([s.psnr for s in scores])))
    if series:
        result["PSNR by frame"] = svg.plot(series, "frame", "dB")
    if stages:
        result["Time by stage"] = html.timing_bars(stages)
    return result
