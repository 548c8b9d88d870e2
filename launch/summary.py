"""The few lines at the end of a run, from report.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FILES = ("report.html", "report.json", "map.ply", "cameras.json", "keyframes", "trajectory.txt", "config.yaml", "logs")


def summary(output: Path) -> str:
    """What the run reached and where its files are."""
    report = json.loads((output / "report.json").read_text())
    lines = ["", *_figures(report)]
    if not report.get("finished", True):
        lines.append(f"no report: {report.get('reason')}")
    elif len(lines) == 1:
        lines.append("no report: the graph has no evaluator here, or it had nothing to score")
    there = [name for name in FILES if (output / name).exists()]
    return "\n".join([*lines, f"in {output}: {', '.join(there)}"])


def _figures(report: Mapping[str, Any]) -> list[str]:
    lines = []
    for part, title in (("keyframes", "keyframes"), ("held_out", "held-out ")):
        after = _image(_get(report, "rendering", part))
        before = _image(_get(report, "rendering_before_refinement", part))
        if after or before:
            lines.append(f"{title}   {after or '-'}" + (f"   (before refinement: {before})" if before else ""))
    lines += _worst(report, "rendering") or _worst(report, "rendering_before_refinement")
    trajectory = _get(report, "trajectory") or {}
    if trajectory:
        tracked = f"{trajectory.get('frames_tracked')} of {trajectory.get('frames')} frames"
        ate = (
            f", ATE {_number(trajectory.get('ate_rmse'))} (RMSE of {trajectory.get('ate_keyframes')} keyframes, in the "
            "true poses' unit)"
        )
        lines.append(
            f"trajectory  {tracked}, {trajectory.get('keyframes')} keyframes"
            + (ate if trajectory.get("ate_rmse") is not None else "")
        )
    depth = _get(report, "depth")
    if depth and depth.get("abs_rel") is not None:
        lines.append(
            f"depth       relative error {_number(depth['abs_rel'])}, within 5 %: "
            f"{_percent(depth.get('inlier_ratio'))}, complete: {_percent(depth.get('completeness'))}, "
            f"{depth.get('count')} keyframes"
        )
    splats, size = _get(report, "map", "splats"), _get(report, "map", "bytes")
    if splats is not None:
        lines.append(f"map         {splats} splats" + (f", {size / 1e6:.1f} MB" if size else ""))
    wall = _get(report, "time", "wall")
    if wall is not None:
        lines.append(f"time        {wall:.1f} s, {_number(_get(report, 'time', 'keyframes_per_second'))} keyframes/s")
    return lines


def _image(scores: Mapping[str, Any] | None) -> str:
    if not scores or scores.get("psnr") is None:
        return ""
    text = f"PSNR {scores['psnr']:.2f} dB, SSIM {_number(scores.get('ssim'))}"
    if scores.get("lpips") is not None:
        text += f", LPIPS {scores['lpips']:.3f}"
    return f"{text}, {scores.get('count')} frames"


def _worst(report: Mapping[str, Any], part: str) -> list[str]:
    """The worst of all frames that were scored, and the one that the map covers least."""
    worst, coverage = _get(report, part, "worst", "all"), _get(report, part, "coverage")
    if not worst or not coverage or coverage.get("min") is None:
        return []
    psnr = "" if worst.get("psnr") is None else f": {worst['psnr']:.2f} dB"
    return [
        f"worst       frame {worst.get('index')} ({worst.get('kind')}){psnr}; least covered: "
        f"frame {coverage.get('min_index')}, {100 * coverage['min']:.1f} % (of {coverage.get('count')} frames)"
    ]


def _get(report: Mapping[str, Any], *path: str) -> Any:
    found: Any = report
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
