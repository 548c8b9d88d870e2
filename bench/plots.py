"""Plots as SVG files that stand alone, and the Pareto front of run time against error."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

_COLORS = ("#2b6cb0", "#dd6b20", "#2f855a", "#805ad5", "#b83280", "#718096", "#975a16", "#2c7a7b")
_STYLE = "text{font:11px sans-serif;fill:#333}.grid{stroke:#ddd;stroke-width:.6}"
_WIDTH, _HEIGHT = 760, 400
_LEFT, _RIGHT, _TOP, _BOTTOM = 60, 170, 16, 44


def write(file: Path, svg: str) -> None:
    """An <svg> element of mvsgs_core.evaluation.svg or of this file, as a file that a browser shows on white."""
    head, _, body = svg.partition(">")
    if not head.startswith("<svg"):
        file.unlink(missing_ok=True)  # nothing to plot
        return
    space = "" if "xmlns" in head else ' xmlns="http://www.w3.org/2000/svg"'
    background = '<rect width="100%" height="100%" fill="white"/>'
    file.write_text(f"{head}{space}><style>{_STYLE}</style>{background}{body}\n")


def pareto(cost: Sequence[float], gain: Sequence[float]) -> list[int]:
    """Positions of the points that no other beats in both, by rising cost; those not finite are left out."""
    order = [i for i in range(len(cost)) if np.isfinite(cost[i]) and np.isfinite(gain[i])]
    order.sort(key=lambda i: (cost[i], -gain[i]))
    front: list[int] = []
    for i in order:
        if not front or gain[i] > gain[front[-1]]:
            front.append(i)
    return front


def front_plot(
    points_of_curves: Iterable[tuple[str, str, float, float]],
    default: tuple[float, float],
    x_label: str,
    y_label: str,
    noise: tuple[float, float] = (0.0, 0.0),
) -> str:
    """Points (curve, label, x, y), each curve by rising x with the default on it; more y for less x is better.

    The front is dashed, the default ringed. noise: of the default, half a range each: drawn as a box around it.
    """
    series: dict[str, list[tuple[str, float, float]]] = {}
    for curve, label, x, y in points_of_curves:
        series.setdefault(curve, [("", *default)]).append((label, x, y))
    series = {curve: sorted(entries, key=lambda entry: entry[1]) for curve, entries in series.items()}
    points = [(x, y) for entries in series.values() for _, x, y in entries] + [default]
    xs, ys = (np.array(values, dtype=float) for values in zip(*points))
    finite = np.isfinite(xs) & np.isfinite(ys)
    if not finite.any():
        return "<p>nothing to plot</p>"
    x0, x1 = _range(xs[finite])
    y0, y1 = _range(ys[finite])
    wide, high = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def at(x: float, y: float) -> tuple[float, float]:
        return _LEFT + (x - x0) / (x1 - x0) * wide, _TOP + high - (y - y0) / (y1 - y0) * high

    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}">']
    for tick in _ticks(x0, x1):
        px = at(tick, y0)[0]
        parts.append(f'<line x1="{px:.1f}" x2="{px:.1f}" y1="{_TOP}" y2="{_TOP + high}" class="grid"/>')
        parts.append(f'<text x="{px:.1f}" y="{_TOP + high + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(y0, y1):
        py = at(x0, tick)[1]
        parts.append(f'<line x1="{_LEFT}" x2="{_LEFT + wide}" y1="{py:.1f}" y2="{py:.1f}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{tick:g}</text>')
    front = " ".join("{:.1f},{:.1f}".format(*at(xs[i], ys[i])) for i in pareto(xs.tolist(), ys.tolist()))
    parts.append(f'<polyline points="{front}" fill="none" stroke="#999" stroke-dasharray="5 3"/>')
    for k, (name, entries) in enumerate(series.items()):
        color = _COLORS[k % len(_COLORS)]
        known = [(label, *at(x, y)) for label, x, y in entries if np.isfinite(x) and np.isfinite(y)]
        way = " ".join(f"{px:.1f},{py:.1f}" for _, px, py in known)
        parts.append(f'<polyline points="{way}" fill="none" stroke="{color}" stroke-width="1" opacity=".6"/>')
        for label, px, py in known:
            parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="3.2" fill="{color}"/>')
            parts.append(f'<text x="{px + 5:.1f}" y="{py - 4:.1f}" style="font-size:9px">{escape(label)}</text>')
        legend = _TOP + 12 + 17 * k
        parts.append(f'<rect x="{_WIDTH - _RIGHT + 12}" y="{legend - 9}" width="10" height="10" fill="{color}"/>')
        parts.append(f'<text x="{_WIDTH - _RIGHT + 27}" y="{legend}">{escape(name)}</text>')
    px, py = at(*default)
    parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="7" fill="none" stroke="#c53030" stroke-width="2"/>')
    if any(noise):
        left, top = at(default[0] - noise[0], default[1] + noise[1])
        size = f'width="{2 * (px - left):.1f}" height="{2 * (py - top):.1f}"'
        parts.append(f'<rect x="{left:.1f}" y="{top:.1f}" {size} fill="#c53030" opacity=".15"/>')
    legend = _TOP + 12 + 17 * len(series)
    parts.append(f'<circle cx="{_WIDTH - _RIGHT + 17}" cy="{legend - 4}" r="5" fill="none" stroke="#c53030"/>')
    parts.append(f'<text x="{_WIDTH - _RIGHT + 27}" y="{legend}">default (dashed: the front)</text>')
    if any(noise):
        parts.append(f'<text x="{_WIDTH - _RIGHT + 27}" y="{legend + 15}">and its noise (box)</text>')
    parts.append(f'<text x="{_LEFT + wide / 2}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>')
    middle = _TOP + high / 2
    turned = f'transform="rotate(-90 14 {middle})"'
    parts.append(f'<text x="14" y="{middle}" text-anchor="middle" {turned}>{escape(y_label)}</text></svg>')
    return "\n".join(parts)


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.06 * (high - low) or max(abs(high) * 0.05, 1e-6)
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 6
    step = 10.0 ** np.floor(np.log10(rough))
    step *= next(f for f in (1.0, 2.0, 5.0, 10.0) if step * f >= rough)
    return [float(t) for t in np.round(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step, 12)]
