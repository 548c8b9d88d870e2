"""The report as one self-contained HTML file: figures, pictures, plots. No request leaves it."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import cv2
import numpy as np

from mvsgs_core.evaluation import metrics, skipped, svg
from mvsgs_core.evaluation.origin import in_words
from mvsgs_core.evaluation.scoring import DepthRange, depth_colors
from mvsgs_core.georeference import in_words as in_words_of_gps
from mvsgs_core.given_frame import in_words as in_words_of_given

_FIRST, _WATCHING = ("tracker", "dataset"), ("viewer", "recorder", "publisher", "evaluator")  # slots, by their warnings
_ENLARGE = "this.parentNode.classList.toggle('large')"
_PRIVATE = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"  # nothing leaves
_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8882; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
td, th { padding: .25rem .8rem; border-bottom: 1px solid var(--line); }
th { text-align: left; } td { text-align: right; font-variant-numeric: tabular-nums; }
td:first-child { text-align: left; }
.pictures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 4px; margin: 2px 0 14px; }
.pictures img { width: 100%; display: block; cursor: zoom-in; } figure { margin: 0; min-width: 0; }
.pictures .large { grid-column: 1 / -1; } .large img { cursor: zoom-out; image-rendering: pixelated; }
.run td { text-align: left; overflow-wrap: anywhere; } .run td:first-child { white-space: nowrap; }
.row { margin: 1.1rem 0 .2rem; font-weight: 600; }
.scale { height: 9px; } .ticks { display: flex; justify-content: space-between; font-size: .75rem; opacity: .8; }
pre { overflow-x: auto; background: var(--soft); padding: .6rem; }
@media (max-width: 700px) {
  body { margin-top: 1rem; } .pictures { grid-template-columns: repeat(2, 1fr); }
  table { font-size: .8rem; } td, th { padding: .2rem .3rem; } .plot { font-size: 14px; }
}
figcaption { font-size: .8rem; opacity: .75; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(420px, 100%), 1fr)); gap: 16px; }
.plot { width: 100%; font-size: 11px; fill: currentColor; background: var(--soft); border-radius: 6px; }
.plot .grid { stroke: var(--line); stroke-width: .6; }
.warning { border-left: 4px solid #dd6b20; padding: .1rem .8rem; background: var(--soft); margin: .3rem 0; }
.better { color: #2f855a; } .worse { color: #c05621; } .runs td, .runs th { white-space: nowrap; }
.runs td:first-child { white-space: normal; }
.warning, figcaption, h1, .row { overflow-wrap: anywhere; }
code { background: var(--soft); padding: .1rem .3rem; }
"""


class Row(NamedTuple):
    """Pictures (H, W, 3) uint8 RGB beside each other, each with its name."""

    caption: str
    pictures: Mapping[str, np.ndarray]
    depths: DepthRange | None = None  # what the colors mean of those with "depth" in their name
    columns: int | None = None  # on any screen; None: as many as it has room for
    empty: int = 0  # columns that stay so at the beginning


def image_tag(picture: np.ndarray, caption: str, below: str = "") -> str:
    """<figure> with an RGB uint8 picture embedded as JPEG; below: HTML under it."""
    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    if not done:
        raise RuntimeError(f"could not encode the picture {caption!r}")
    encoded = base64.b64encode(data.tobytes()).decode()
    text = escape(caption)
    handlers = f"""onclick="{_ENLARGE}" onkeydown="if(event.key=='Enter'){_ENLARGE}" """
    image = f'<img alt="{text}" title="click: larger" tabindex="0" {handlers}src="data:image/jpeg;base64,{encoded}">'
    return f"<figure>{image}{below}<figcaption>{text}</figcaption></figure>"


def _three(value: float) -> str:
    return f"{value:#.3g}".rstrip(".")


def depth_scale(depths: DepthRange) -> str:
    """The colors of a depth map, and depths in the map's unit, evenly along them."""
    ticks = "".join(f"<span>{_three(depths.at(part))}</span>" for part in (0.0, 0.25, 0.5, 0.75, 1.0))
    colors = ", ".join(depth_colors(16))
    bar = f'<div class="scale" style="background: linear-gradient(to right, {colors})"></div>'
    return f'{bar}<div class="ticks">{ticks}</div>'


def rendering_table(report: Mapping[str, Any]) -> str:
    after = report["rendering"]
    known = [
        m for m in metrics.IMAGE if any(after[kind][m.key] is not None for kind in ("keyframes", "held_out", "all"))
    ]
    titles = ("frames", "refine&shy;ment", *(f"{m.label} {m.unit}".strip() for m in known), "count")
    rows = ["<tr>" + "".join(f"<th>{title}</th>" for title in titles) + "</tr>"]
    kinds = {"keyframes": "keyframes", "held_out": "held-out", "held_out_fitted": "held-out, fitted", "all": "all"}
    for kind, name in kinds.items():
        for when, key in (("before", "rendering_before_refinement"), ("after", "rendering")):
            means = report[key][kind]
            if kind == "held_out_fitted" and not means["count"]:
                continue
            values = (m.text(means[m.key], unit=False) for m in known)
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
    comparisons: Sequence[Row],
    depth_maps: Sequence[Row],
    plots: Mapping[str, str],
) -> str:
    """The whole document."""
    trajectory, depth = report["trajectory"], report["depth"]
    figures = {
        **_metrics("", metrics.TRAJECTORY, trajectory),
        **(in_words_of_gps(report["georeference"]) if report.get("georeference") else {}),
        **(in_words_of_given(report["given_frame"]) if report.get("given_frame") else {}),
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
    left_out = skipped.in_words(report.get("skipped", {}))
    warnings = sorted_warnings(report)
    named = re.sub("(^| )/.*/", r"\1", str(report.get("input") or ""))  # without the folders
    body = [
        f"<h1>{escape(f'{title}: {named}' if named else title)}</h1>",
        f'<div class="run">{figures_table(in_words(report))}</div>',
        _settings(report.get("run", {}).get("settings")),
        "<h2>Warnings, the costliest first</h2>" if warnings else "<p>No warnings.</p>",
        *(f'<p class="warning">{escape(w)}</p>' for w in warnings),
        "<h2>Rendering</h2>",
        f"<p>{escape(report.get('protocol', ''))}</p>",
        rendering_table(report),
        figures_table(worst_figures(report["rendering"])),
        *map(row, comparisons),
        "<h2>Figures</h2>",
        figures_table(figures),
        *latency_table(report.get("latency", {})),
        '<h2>Plots</h2><div class="plots">',
        *(f"<div><b>{escape(name)}</b>{plot}</div>" for name, plot in plots.items()),
        "</div>",
        "<h2>Depth maps of keyframes, filtered</h2>",
        *map(row, depth_maps),
        "<h2>Skipped work</h2>",
        figures_table(left_out) if left_out else "<p>nothing</p>",
        "<h2>Peak memory</h2>",
        figures_table(memory),
    ]
    return document(f"{title} {named}".strip(), body)


def document(title: str, body: Sequence[str]) -> str:
    """A whole page of these parts."""
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    meta += f'<meta http-equiv="Content-Security-Policy" content="{_PRIVATE}">'
    head = f"{meta}<title>{escape(title)}</title><style>{_STYLE}</style>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>'


def sorted_warnings(report: Mapping[str, Any]) -> list[str]:
    """What was warned of, by what it costs: a stream that was cut off, as it may explain the rest, no result at all,
    then the poses on which all else stands, the stages after them, and what only watches, of which no map depends."""
    said = {str(node): list(texts) for node, texts in report.get("warnings", {}).items()}
    last = [node for node in said if node in _WATCHING]
    order = [node for node in _FIRST if node in said]
    order += [node for node in said if node not in (*order, *last)]
    warnings = [f"{node}: {text}" for key in ("cut_off", "nothing") for node, text in report.get(key, {}).items()]
    warnings += [f"{node}: {text}" for node in order for text in said[node]]
    warnings += [*report.get("notes", []), *(f"{node}: {text}" for node in last for text in said[node])]
    return list(dict.fromkeys(warnings))


def _settings(text: str | None) -> str:
    return f"<details><summary>all settings</summary><pre>{escape(text)}</pre></details>" if text else ""


def row(shown: Row) -> str:
    scale = "" if shown.depths is None else depth_scale(shown.depths)
    figures = (
        image_tag(picture, name + (", the map's unit" if below else ""), below)
        for name, picture in shown.pictures.items()
        for below in [scale if "depth" in name else ""]
    )
    caption = f'<p class="row">{escape(shown.caption)}</p>' if shown.caption else ""
    columns = f' style="grid-template-columns: repeat({shown.columns}, 1fr)"' if shown.columns else ""
    return f'{caption}<div class="pictures"{columns}>{"<div></div>" * shown.empty}{"".join(figures)}</div>'


def timing_bars(stages: Mapping[str, Mapping[str, float]]) -> str:
    values = {f"{node}: {name}": s for node, parts in stages.items() for name, s in parts.items() if s >= 0.005}
    return svg.bars(dict(sorted(values.items(), key=lambda item: -item[1])[:24]), "s", width=480)
