"""The report as one self-contained HTML file: figures, pictures, plots. No request leaves it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

from mvsgs_core.evaluation import metrics, svg

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8882; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; } td, th { padding: .25rem .8rem; border-bottom: 1px solid var(--line); }
th { text-align: left; } td { text-align: right; font-variant-numeric: tabular-nums; }
td:first-child { text-align: left; }
.pictures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 4px; margin: 2px 0 14px; }
.pictures img { width: 100%; display: block; } figure { margin: 0; }
figcaption { font-size: .8rem; opacity: .75; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(420px, 1fr)); gap: 16px; }
.plot { width: 100%; font-size: 11px; fill: currentColor; background: var(--soft); border-radius: 6px; }
.plot .grid { stroke: var(--line); stroke-width: .6; }
.warning { border-left: 4px solid #dd6b20; padding: .1rem .8rem; background: var(--soft); margin: .3rem 0; }
code { background: var(--soft); padding: .1rem .3rem; }
"""


def image_tag(picture: np.ndarray, caption: str) -> str:
    """<figure> with an RGB uint8 picture embedded as JPEG."""
    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    if not done:
        raise RuntimeError(f"could not encode the picture {caption!r}")
    encoded = base64.b64encode(data.tobytes()).decode()
    text = escape(caption)
    return f'<figure><img alt="{text}" src="data:image/jpeg;base64,{encoded}"><figcaption>{text}</figcaption></figure>'


def rendering_table(report: Mapping[str, Any]) -> str:
    titles = ("frames", "refinement", *(f"{m.label} {m.unit}".strip() for m in metrics.IMAGE), "count")
    rows = ["<tr>" + "".join(f"<th>{title}</th>" for title in titles) + "</tr>"]
    kinds = {"keyframes": "keyframes", "held_out": "held-out", "held_out_fitted": "held-out, fitted", "all": "all"}
    for kind, name in kinds.items():
        for when, key in (("before", "rendering_before_refinement"), ("after", "rendering")):
            means = report[key][kind]
            if kind == "held_out_fitted" and not means["count"]:
                continue
            values = (m.text(means[m.key], unit=False) for m in metrics.IMAGE)
            cells = (name, when, *values, means["count"])
            rows.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    return f"<table>{''.join(rows)}</table>"


def worst_figures(rendering: Mapping[str, Any]) -> dict[str, str]:
    """The worst frames and how much of the frames the map covers, from `report["rendering"]`."""
    coverage, first = rendering["coverage"], metrics.IMAGE[0]
    figures = {}
    for name, worst, count in (
        ("worst held-out frame", rendering["worst"]["held_out"], rendering["held_out"]["count"]),
        ("worst of all frames scored", rendering["worst"]["all"], rendering["all"]["count"]),
    ):
        if worst:
            figures[f"{name} ({count})"] = f"{worst['index']} ({worst['kind']}): {first.text(worst[first.key])}"
    if coverage["count"]:
        mean, least = (f"{100 * coverage[key]:.1f} %" for key in ("mean", "min"))
        figures[f"pixels covered by the map, of {coverage['count']} frames"] = (
            f"{mean}; least {least}, frame {coverage['min_index']}"
        )
    return figures


def figures_table(figures: Mapping[str, Any]) -> str:
    rows = [f"<tr><td>{escape(str(k))}</td><td>{escape(str(v))}</td></tr>" for k, v in figures.items()]
    return f"<table>{''.join(rows)}</table>"


def latency_table(latency: Mapping[str, Any]) -> list[str]:
    """How old things are when they are done, since the camera took them; nothing where no camera was waited for."""
    rows = {
        what: f"{_seconds(found.get('median'))}; 99 %: {_seconds(found.get('p99'))} ({found.get('count')})"
        for by_name in latency.values()
        for what, found in by_name.items()
    }
    return ["<h2>Latency, median</h2>", figures_table(rows)] if rows else []


def _seconds(value: float | None) -> str:
    return "–" if value is None else f"{1e3 * value:.0f} ms"


def _metrics(prefix: str, entries: Sequence[metrics.Metric], values: Mapping[str, Any]) -> dict[str, str]:
    return {prefix + metric.name: metric.text(values[metric.key]) for metric in entries}


def _span(trajectory: Mapping[str, Any]) -> str:
    first, last = trajectory["first_tracked"], trajectory["last_tracked"]
    return "" if first is None else f", {first} to {last}"


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())


def _some(indices: Sequence[int], limit: int = 8) -> str:
    if not indices:
        return "none"
    return f"{len(indices)}: {', '.join(map(str, indices[:limit]))}{', …' if len(indices) > limit else ''}"


def page(
    title: str,
    report: Mapping[str, Any],
    comparisons: Sequence[tuple[str, Mapping[str, np.ndarray]]],
    depth_maps: Sequence[tuple[str, Mapping[str, np.ndarray]]],
    plots: Mapping[str, str],
) -> str:
    """The whole document. comparisons and depth_maps: (caption, pictures by name) a row."""
    trajectory, depth = report["trajectory"], report["depth"]
    figures = {
        **_metrics("", metrics.TRAJECTORY, trajectory),
        "keyframes with a true pose": trajectory["ate_keyframes"],
        "frames tracked": f"{trajectory['frames_tracked']} of {trajectory['frames']}{_span(trajectory)}",
        "frames without a pose": _listed(trajectory["frames_without_pose"]) or "none",
        "frames with a pose of too little motion or texture": trajectory["frames_degenerate"],
        "keyframes": trajectory["keyframes"],
        "keyframes that were to be held out": _some(trajectory["held_out_keyframes"]),
        "filtered depth: keyframes with true depth": depth["count"],
        **_metrics("filtered depth: ", metrics.DEPTH, depth),
        **{m.name: m.text(report[place.partition(".")[0]][m.key]) for place, m in metrics.RUN.items() if m.name},
    }
    memory = {node: f"{size / 1e6:.0f} MB" for node, size in report.get("memory", {}).get("peak_bytes", {}).items()}
    skipped = {
        f"{node}: {what}": f"{n:,.10g}" for node, s in report.get("skipped", {}).items() for what, n in s.items()
    }
    warnings = [f"{node}: {text}" for node, text in report.get("nothing", {}).items()]
    warnings += [f"{node}: {text}" for node, texts in report.get("warnings", {}).items() for text in texts]
    warnings += report.get("notes", [])
    origin = [report.get("input"), report.get("date"), report.get("version") and f"MVS-GS {report['version']}"]
    body = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(' · '.join(str(part) for part in origin if part))}</p>",
        f"<p>{escape(report.get('protocol', ''))}</p>",
        "".join(f'<p class="warning">{escape(w)}</p>' for w in warnings),
        "<h2>Rendering</h2>",
        rendering_table(report),
        figures_table(worst_figures(report["rendering"])),
        *(_row(caption, pictures) for caption, pictures in comparisons),
        "<h2>Figures</h2>",
        figures_table(figures),
        *latency_table(report.get("latency", {})),
        '<h2>Plots</h2><div class="plots">',
        *(f"<div><b>{escape(name)}</b>{plot}</div>" for name, plot in plots.items()),
        "</div>",
        "<h2>Depth maps of keyframes, filtered</h2>",
        *(_row(caption, pictures) for caption, pictures in depth_maps),
        "<h2>Skipped work</h2>",
        figures_table(skipped) if skipped else "<p>nothing</p>",
        "<h2>Peak memory</h2>",
        figures_table(memory),
    ]
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head = f"{meta}<title>{escape(title)}</title><style>{_STYLE}</style>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>'


def _row(caption: str, pictures: Mapping[str, np.ndarray]) -> str:
    figures = "".join(image_tag(picture, name) for name, picture in pictures.items())
    return f'<b>{escape(caption)}</b><div class="pictures">{figures}</div>'


def timing_bars(stages: Mapping[str, Mapping[str, float]]) -> str:
    values = {f"{node}: {name}": s for node, parts in stages.items() for name, s in parts.items() if s >= 0.005}
    return svg.bars(dict(sorted(values.items(), key=lambda item: -item[1])[:24]), "s")
