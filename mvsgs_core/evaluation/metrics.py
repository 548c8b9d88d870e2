"""The metrics of a run. Each is one entry here: report, summary and benchmarks take what they say of it from that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal

from mvsgs_core import image_metrics
from mvsgs_core.evaluation.depth_metrics import DepthScore
from mvsgs_core.evaluation.trajectory_metrics import rmse


@dataclass(frozen=True)
class Metric:
    """One figure of report.json."""

    key: str  # in its part of the report
    label: str  # short: a table's heading
    unit: str
    digits: int  # after the point
    better: Literal["higher", "lower", ""]  # "": neither
    name: str = ""  # in full, where the report lists it; none: it is not listed
    # What it is of: an image metric of a render and the photograph (H, W, 3) float32 in 0..1, and the mask (H, W) bool
    # where there is one; of depth a DepthScore, of poses KnownPoses; None: given at run time, or counted
    of: Callable[..., float | None] | None = None
    factor: float = 1.0  # from the report's value to the unit

    def text(self, value: float | None, unit: bool = True) -> str:
        """The report's value as a table shows it."""
        if value is None:
            return "–"
        shown = f"{self.factor * value:,.{self.digits}f}"
        return f"{shown} {self.unit}" if unit and self.unit else shown


@dataclass(frozen=True)
class Figure:
    """One figure of several runs; differences are those from the first."""

    name: str
    metric: Metric
    values: Sequence[float | None]

    def cells(self) -> list[str]:
        """The figures, after the first with what each has more."""
        first, metric = self.values[0], self.metric
        cells = [metric.text(first, unit=False)]
        for value in self.values[1:]:
            more = "" if value is None or first is None else f" ({metric.factor * (value - first):+,.{metric.digits}f})"
            cells.append(metric.text(value, unit=False) + more)
        return cells

    def better(self) -> list[bool | None]:
        """Of each run, whether it is better than the first; None where it shows no difference, or neither is better."""
        first, metric = self.values[0], self.metric
        found: list[bool | None] = []
        for value in self.values:
            same = value is None or first is None or metric.text(value) == metric.text(first)
            found.append(None if same or not metric.better else (value > first) == (metric.better == "higher"))  # type: ignore[operator]
        return found


BEST_PSNR = 100.0  # dB: of a render that equals its photograph it has no bound, and no mean either


def _psnr(*pair: Any) -> float:
    return min(image_metrics.psnr(*pair), BEST_PSNR)


# The first of them ranks the frames: what is called the worst frame is the worst by it.
IMAGE = (
    Metric("psnr", "PSNR", "dB", 2, "higher", of=_psnr),
    Metric("ssim", "SSIM", "", 3, "higher", of=image_metrics.ssim),
    Metric("lpips", "LPIPS", "", 3, "lower"),  # its network is loaded where its weights are found
)
DEPTH = (
    Metric("abs_rel", "abs rel", "", 4, "lower", "absolute relative error", DepthScore.abs_rel),
    Metric("inlier_ratio", "inliers", "", 3, "higher", "inliers within 5 %", DepthScore.inlier_ratio),
    Metric("completeness", "complete", "", 3, "higher", "completeness", DepthScore.completeness),
)
TRAJECTORY = (
    Metric(
        "ate_rmse", "ATE", "", 4, "lower", "ATE RMSE of keyframes (after Sim(3), unit of the true poses)",
        lambda poses: poses.keyframe_error,
    ),
    Metric(
        "ate_percent", "ATE %", "% of the path", 2, "lower", "ATE RMSE of keyframes, of the path",
        lambda poses: poses.keyframe_percent,
    ),
    Metric("ate_rmse_frames", "ATE of all", "", 4, "lower", "ATE RMSE of all frames", lambda poses: rmse(poses.errors)),
    Metric("rpe_translation", "RPE", "", 4, "lower", "RPE of translation by frame", lambda poses: poses.relative[0]),
    Metric("rpe_rotation", "RPE, turn", "°", 3, "lower", "RPE of rotation by frame", lambda poses: poses.relative[1]),
)  # fmt: skip
RUN = {  # by their place in the report
    "rendering.generalization_gap": Metric(
        "generalization_gap", "KF − held-out", "dB", 2, "lower", "PSNR of keyframes above that of held-out frames"
    ),
    "trajectory.keyframes": Metric("keyframes", "KFs", "", 0, ""),
    "map.splats": Metric("splats", "splats", "", 0, "", "splats"),
    "map.bytes": Metric("bytes", "MB", "MB", 1, "lower", "map size", factor=1e-6),
    "map.iterations": Metric("iterations", "steps", "", 0, "", "optimization steps"),
    "time.wall": Metric("wall", "wall s", "s", 1, "lower", "wall time, first frame to finished map"),
    "time.keyframes_per_second": Metric("keyframes_per_second", "KF/s", "1/s", 2, "higher", "keyframes per second"),
    "time.cpu.*": Metric("cpu", "CPU s", "s", 1, "lower"),
}
COUNTS = {  # of how many frames those are, by their place in the report
    "trajectory.frames_tracked": Metric("frames_tracked", "frames tracked", "", 0, ""),
    "rendering.held_out.count": Metric("count", "held-out frames scored", "", 0, ""),
    "rendering.keyframes.count": Metric("count", "keyframes scored", "", 0, ""),
}
METRICS = {
    **{f"rendering*.{metric.key}": metric for metric in IMAGE},
    **{f"depth.{metric.key}": metric for metric in DEPTH},
    **{f"trajectory.{metric.key}": metric for metric in TRAJECTORY},
    **RUN,
    **COUNTS,
}


def at(path: str) -> Metric:
    """The metric at a path of the report, such as "rendering.held_out.psnr". Raises KeyError where there is none."""
    for pattern, metric in METRICS.items():
        if fnmatchcase(path, pattern):
            return metric
    raise KeyError(f"no metric at {path!r} of the report; there are: {', '.join(METRICS)}")


def value(report: Mapping[str, Any], place: str) -> Any:
    """What a report has at a place such as "rendering.held_out"; None where it has nothing."""
    found: Any = report
    for key in place.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def number(report: Mapping[str, Any], place: str) -> float | None:
    """The figure at a place such as "rendering.held_out.psnr"; None where there is none."""
    found = value(report, place)
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


def of_all(metrics: tuple[Metric, ...], measured: Any) -> dict[str, float | None]:
    """The value of each metric, by key; None for all where nothing was `measured`."""
    return {m.key: None if measured is None or m.of is None else m.of(measured) for m in metrics}


def listed(metrics: tuple[Metric, ...], values: Mapping[str, Any]) -> str:
    """Those that have a value, in a line: "PSNR 31.20 dB, SSIM 0.912"."""
    known = [(m, values[m.key]) for m in metrics if values.get(m.key) is not None]
    return ", ".join(f"{metric.label} {metric.text(value)}" for metric, value in known)


__all__ = [
    "COUNTS", "DEPTH", "IMAGE", "METRICS", "RUN", "TRAJECTORY", "Figure", "Metric", "at", "listed", "number", "of_all",
    "value",
]  # fmt: skip
