"""The tracker's run time against its error over the main settings, one at a time: is the default on the front?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench import plots
from bench.table import Row
from mvsgs_core.tracking.keyframe_choice import KeyframeChoiceConfig
from mvsgs_core.tracking.tracker import TrackerConfig

TIME_NOISE, ERROR_NOISE = 1.05, 1.15  # a setting beats the default if it is that many times faster and more exact
SEQUENCES = ("tum_fr1_xyz", "room")


@dataclass(frozen=True)
class Point:
    """A setting's run over one sequence."""

    setting: str  # what is changed
    label: str  # to what
    milliseconds: float  # processor time a frame, all of the tracker
    error: float  # ATE of the keyframes, cm
    keyframes: int


def settings() -> dict[tuple[str, str], TrackerConfig]:
    """By setting and label; ("default", "") is what there is without a word."""
    base = TrackerConfig()

    def keyframe_flow(flow: float) -> TrackerConfig:
        return replace(base, keyframe_choice=KeyframeChoiceConfig(max_flow=flow))

    def local(**changes: int) -> TrackerConfig:
        return replace(base, local_map=replace(base.local_map, **changes))

    return {
        ("default", ""): base,
        ("size", "192x144"): replace(base, area=192 * 144),
        ("size", "256x192"): replace(base, area=256 * 192),
        ("size", "512x384"): replace(base, area=512 * 384),
        ("keyframe flow", "0.035"): keyframe_flow(0.035),
        ("keyframe flow", "0.08"): keyframe_flow(0.08),
        ("keyframe flow", "0.12"): keyframe_flow(0.12),
        ("edges", "1 recent, 0 near"): local(recent=1, proximity=0),
        ("edges", "2 recent, 2 near"): local(recent=2, proximity=2),
        ("edges", "6 recent, 6 near"): local(recent=6, proximity=6),
        ("window", "6"): local(window=6),
        ("window", "20"): local(window=20),
        ("iterations", "2"): local(steps=2),
        ("iterations", "10"): local(steps=10),
        ("flow", "dis"): replace(base, flow="dis"),
        ("flow", "features"): replace(base, flow="features"),
        ("loops", "none"): replace(base, loops=False),
    }


def measure(run: Callable[[TrackerConfig], tuple[float, float, int]]) -> list[Point]:
    """run: milliseconds a frame, ATE in cm and number of keyframes of a configuration."""
    return [Point(setting, label, *run(config)) for (setting, label), config in settings().items()]


def rows(name: str, points: Sequence[Point]) -> list[Row]:
    """A row for each setting with whether it is on the front, and whether the default is, within the noise."""
    front = plots.pareto([p.milliseconds for p in points], [-p.error for p in points])
    found = []
    for k, point in enumerate(points):
        where = "on the front" if k in front else "not on the front"
        text = f"cm at {point.milliseconds:.1f} ms/frame CPU, {point.keyframes} keyframes, {where}"
        value = point.error if np.isfinite(point.error) else "not tracked"
        found.append(Row(f"{name}, {point.setting} {point.label}".rstrip(), value, text))
    default = points[0]
    better = [f"{p.setting} {p.label}" for p in points[1:] if beats(p, default)]
    text = f"no: {', '.join(better)}" if better else "yes"
    goal = f"by {100 * (TIME_NOISE - 1):.0f} % of time and {100 * (ERROR_NOISE - 1):.0f} % of error"
    found.append(Row(f"{name}, default on the front", text, "", f"not beaten {goal}", not better))
    return found


def beats(point: Point, other: Point) -> bool:
    """Faster and more exact, both by more than the noise."""
    return point.milliseconds * TIME_NOISE < other.milliseconds and point.error * ERROR_NOISE < other.error


def draw(file: Path, points: Sequence[Point]) -> None:
    """The curves, error upside down so that better is up; settings that are off by a multiple are left out."""
    default = points[0]
    drawn = [(p.setting, p.label, p.milliseconds, -p.error) for p in points[1:] if p.error < 6.0 * default.error]
    ringed = (default.milliseconds, -default.error)
    plots.write(file, plots.front_plot(drawn, ringed, "processor time, ms a frame", "- ATE of keyframes, cm"))
