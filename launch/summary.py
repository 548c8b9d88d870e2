"""The few lines at the end of a run, from report.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvsgs_core.evaluation import metrics
from mvsgs_core.evaluation.metrics import value

FILES = ("report.html", "report.json", "map.ply", "cameras.json", "transforms.json", "keyframes", "trajectory.txt",
         "localization.csv", "comparison.png", "georeference.json", "given_frame.json", "checkpoint",
         "config.yaml", "logs")  # fmt: skip

ROUNDING = 1e-9  # of a pose's unit


def summary(output: Path) -> str:
    """What the run reached and where its files are."""
    report = json.loads((output / "report.json").read_text())
    figures = _figures(report)
    lines = ["", *figures, *(f"{node:11} {text}" for node, text in (value(report, "cut_off") or {}).items())]
    if not report.get("finished", True):
        lines.append(f"no report: {report.get('reason')}")
    elif not figures:
        lines.append("no report: the graph has no evaluator here, or it had nothing to score")
    there = [name for name in FILES if (output / name).exists()]
    return "\n".join([*lines, f"in {output}: {', '.join(there)}"])


def _figures(report: Mapping[str, Any]) -> list[str]:
    lines = []
    for part, title in (("keyframes", "keyframes"), ("held_out", "held-out ")):
        after = _image(value(report, f"rendering.{part}"))
        before = _image(value(report, f"rendering_before_refinement.{part}"))
        if after or before:
            lines.append(f"{title}   {after or '-'}" + (f"   (before refinement: {before})" if before else ""))
    if fitted := _image(value(report, "rendering.held_out_fitted")):
        lines.append(f"  fitted    {fitted}, their poses and exposures fitted at test time")
    lines += _worst(report, "rendering") or _worst(report, "rendering_before_refinement")
    trajectory = value(report, "trajectory") or {}
    if trajectory:
        ate, number = metrics.listed(metrics.TRAJECTORY[:1], trajectory), f"{trajectory.get('ate_keyframes')} keyframes"
        if not ate:  # too few of them have a true pose
            ate, number = metrics.listed(metrics.TRAJECTORY[2:3], trajectory), f"{trajectory.get('ate_frames')} frames"
        behind = f"(RMSE of {number}, in the true poses' unit)"
        lines.append(
            f"trajectory  {trajectory.get('frames_tracked')} of {trajectory.get('frames')} frames, "
            f"{trajectory.get('keyframes')} keyframes" + (f", {ate} {behind}" if ate else "")
        )
    if place := value(report, "georeference"):
        sure = f"unit {100 * place['scale_deviation']:.2g} %, orientation {place['angle_deviation']:.2g} degrees"
        lines.append(
            f"GPS         {place['residual']:.2f} m from {place['positions']} positions (median), {place['outliers']} "
            f"outliers; sure to {sure}; metres: mvsgs export RUN OUT --frame enu"
        )
    given = value(report, "given_frame")
    if given and given["distance"] > ROUNDING:  # else the map was made of them
        lines.append(
            f"given poses {given['distance']:.4g} from the trajectory (median of {given['poses']}), in their unit; the "
            "map in their frame: mvsgs export RUN OUT --frame given"
        )
    depth = value(report, "depth") or {}
    if errors := metrics.listed(metrics.DEPTH, depth):
        lines.append(f"depth       {errors}, {depth.get('count')} keyframes")
    splats = value(report, "map.splats")  # without an evaluator the map is a word, not figures
    if splats is not None:
        lines.append(f"map         {splats} splats, {metrics.at('map.bytes').text(value(report, 'map.bytes'))}")
    times = value(report, "time") or {}
    if times.get("wall") is not None:
        wall, pace = metrics.at("time.wall"), metrics.at("time.keyframes_per_second")
        rate = pace.text(times.get(pace.key), unit=False)
        lines.append(f"time        {wall.text(times['wall'])}, {rate} keyframes/s")
    for by_name in (value(report, "latency") or {}).values():
        for what, found in by_name.items():
            median, p99 = 1e3 * found.get("median", 0.0), 1e3 * found.get("p99", 0.0)
            lines.append(f"latency     {what}: {median:.0f} ms, 99 %: {p99:.0f} ms ({found.get('count')})")
    return lines


def _image(scores: Mapping[str, Any] | None) -> str:
    figures = metrics.listed(metrics.IMAGE, scores or {})
    return f"{figures}, {scores.get('count')} frames" if scores and figures else ""


def _worst(report: Mapping[str, Any], part: str) -> list[str]:
    """The worst of all frames that were scored, and the one that the map covers least."""
    worst, coverage = value(report, f"{part}.worst.all"), value(report, f"{part}.coverage")
    if not worst or not coverage or coverage.get("min") is None:
        return []
    figure = metrics.listed(metrics.IMAGE[:1], worst)
    return [
        f"worst       frame {worst.get('index')} ({worst.get('kind')}){figure and f': {figure}'}; least covered: "
        f"frame {coverage.get('min_index')}, {100 * coverage['min']:.1f} % (of {coverage.get('count')} frames)"
    ]
