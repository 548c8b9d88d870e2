"""Plots as SVG text, for a report that is one file and needs no plotting library."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

_COLORS = ("#2b6cb0", "#dd6b20", "#2f855a", "#805ad5", "#c53030", "#319795", "#d53f8c", "#4a5568")
_SLOT, _LETTER = 130, 7  # pixels of a name in the legend, at least, and of a letter


@dataclass(frozen=True)
class Series:
    name: str
    x: np.ndarray
    y: np.ndarray
    points: bool = False  # dots instead of a line
    values: np.ndarray | None = None  # dots in colors that say these, and how is beside the plot; instead of `points`


def plot(
    series: list[Series],
    x_label: str,
    y_label: str,
    width: int = 560,
    height: int = 320,
    equal: bool = False,
) -> str:
    """A line or scatter plot as an <svg> element; `equal`: both axes to one scale. Values not finite are left out."""
    series = [_finite(s) for s in series]
    series = [s for s in series if len(s.x)]
    if not series:
        return "<p>nothing to plot</p>"
    valued = next((s for s in series if s.values is not None), None)
    x0, x1 = _range(np.concatenate([s.x for s in series]))
    y0, y1 = _range(np.concatenate([s.y for s in series]))
    longest = max(len(f"{tick:g}") for tick in (*_ticks(y0, y1), 0.0))
    left, right, bottom = 30 + 8 * max(longest, 4), 12 if valued is None else 70, 42
    plot_w = width - left - right
    names = [s.name for s in series if s.values is None]
    slot = max([_SLOT, *(30 + _LETTER * len(name) for name in names)])
    in_row = max(1, plot_w // slot)
    more = 16 * (max(0, len(names) - 1) // in_row)  # pixels of the legend's further rows, which the plot is higher by
    top, height = 26 + more, height + more
    plot_h = height - top - bottom
    if equal:
        unit = max((x1 - x0) / plot_w, (y1 - y0) / plot_h)
        x0, x1 = (x0 + x1) / 2 - unit * plot_w / 2, (x0 + x1) / 2 + unit * plot_w / 2
        y0, y1 = (y0 + y1) / 2 - unit * plot_h / 2, (y0 + y1) / 2 + unit * plot_h / 2

    def px(x: np.ndarray | float) -> np.ndarray:
        return np.asarray(left + (np.asarray(x) - x0) / (x1 - x0) * plot_w)

    def py(y: np.ndarray | float) -> np.ndarray:
        return np.asarray(top + plot_h - (np.asarray(y) - y0) / (y1 - y0) * plot_h)

    parts = [f'<svg viewBox="0 0 {width} {height}" class="plot" role="img">']
    for tick in _ticks(x0, x1):
        parts.append(f'<line x1="{px(tick):.1f}" x2="{px(tick):.1f}" y1="{top}" y2="{top + plot_h}" class="grid"/>')
        parts.append(f'<text x="{px(tick):.1f}" y="{top + plot_h + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(y0, y1):
        parts.append(f'<line x1="{left}" x2="{left + plot_w}" y1="{py(tick):.1f}" y2="{py(tick):.1f}" class="grid"/>')
        parts.append(f'<text x="{left - 6}" y="{float(py(tick)) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    named = 0
    for k, s in enumerate(series):
        color = _COLORS[k % len(_COLORS)]
        if s.values is not None:
            places = zip(px(s.x), py(s.y), _value_colors(s.values, *_ends(s.values)))
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{shade}"/>' for x, y, shade in places]
            continue  # its legend is the scale
        elif s.points:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.4" fill="{color}"/>' for x, y in zip(px(s.x), py(s.y))]
        else:
            way = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(px(s.x), py(s.y)))
            parts.append(f'<polyline points="{way}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        legend_x, legend_y = left + 8 + named % in_row * slot, 8 + named // in_row * 16
        parts.append(f'<rect x="{legend_x}" y="{legend_y}" width="10" height="10" fill="{color}"/>')
        parts.append(f'<text x="{legend_x + 14}" y="{legend_y + 9}">{escape(s.name)}</text>')
        named += 1
    parts.append(f'<text x="{left + plot_w / 2}" y="{height - 8}" text-anchor="middle">{escape(x_label)}</text>')
    middle = top + plot_h / 2
    parts.append(
        f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{escape(y_label)}</text>'
    )
    if valued is not None and valued.values is not None:
        parts += _scale(*_ends(valued.values), valued.name, left + plot_w + 12, top, plot_h)
    parts.append("</svg>")
    return "\n".join(parts)


def bars(values: dict[str, float], unit: str, width: int = 560) -> str:
    """Horizontal bars as an <svg> element, in the order given."""
    if not values:
        return "<p>nothing to plot</p>"
    row, left, right = 20, 230, 80
    longest = max(max(values.values()), 1e-12)
    parts = [f'<svg viewBox="0 0 {width} {row * len(values) + 6}" class="plot" role="img">']
    for k, (name, value) in enumerate(values.items()):
        y = k * row + 4
        length = (width - left - right) * max(value, 0.0) / longest
        parts.append(f'<text x="{left - 6}" y="{y + 12}" text-anchor="end">{escape(name)}</text>')
        parts.append(f'<rect x="{left}" y="{y}" width="{length:.1f}" height="{row - 6}" fill="{_COLORS[0]}"/>')
        parts.append(f'<text x="{left + length + 5:.1f}" y="{y + 12}">{value:.3g} {escape(unit)}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


def _finite(s: Series) -> Series:
    keep = np.isfinite(s.x) & np.isfinite(s.y)
    if s.values is not None:
        keep &= np.isfinite(s.values)
    values = None if s.values is None else np.asarray(s.values)[keep]
    return Series(s.name, np.asarray(s.x)[keep], np.asarray(s.y)[keep], s.points, values)


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Of a scale of colors: without the outermost percent, so that one frame does not take all colors."""
    low, high = np.percentile(values, [1, 99])
    return float(low), float(high)


def _value_colors(values: np.ndarray, low: float, high: float) -> list[str]:
    """Dark blue for `low` to yellow for `high` (viridis)."""
    part = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    found = cv2.applyColorMap((255 * part).round().astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in found[:, 0].tolist()]


def _scale(low: float, high: float, name: str, x: float, y: float, height: float) -> list[str]:
    """A bar of the colors with three of its values, the high ones above."""
    steps = 24
    shades = _value_colors(np.linspace(high, low, steps), low, high)
    step = height / steps
    parts = [
        f'<rect x="{x}" y="{y + k * step:.2f}" width="10" height="{step + 0.5:.2f}" fill="{shade}"/>'
        for k, shade in enumerate(shades)
    ]
    for part in (0.0, 0.5, 1.0):
        text = f"{high + part * (low - high):.4g}"
        parts.append(f'<text x="{x + 14}" y="{y + part * height + 4:.1f}">{text}</text>')
    parts.append(f'<text x="{x + 58}" y="{y - 10}" text-anchor="end">{escape(name)}</text>')
    return parts


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or max(abs(high) * 0.05, 1e-6)
    return low - margin, high + margin


def _ticks(low: float, high: float) -> np.ndarray:
    step = 10.0 ** np.floor(np.log10(high - low))
    for factor in (0.1, 0.2, 0.5, 1.0):
        if (high - low) / (step * factor) <= 7:
            step *= factor
            break
    ticks = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    return np.asarray(np.round(ticks, 12) + 0.0)  # no -0
