"""The constants of DROID-SLAM's 2021/22 generation, by the name of the setting that they were published for.

All thresholds are in pixels of the 1/8 map.
"""

from __future__ import annotations

from dataclasses import dataclass

AREA = 384 * 512  # pixels of the image that the networks see


@dataclass(frozen=True)
class Preset:
    """The defaults are those of the `demo` setting."""

    stride: int = 3  # frames: every which one may become a keyframe
    filter_threshold: float = 2.4  # mean revision of the flow that lets a frame pass the motion filter
    warmup: int = 8  # keyframes before the start is solved
    beta: float = 0.3  # share of the full flow in the distance of two frames, against that of translation alone
    keyframe_threshold: float = 4.0  # distance below which a keyframe is dropped again
    frontend_threshold: float = 16.0  # largest distance of an edge by proximity
    frontend_window: int = 25  # keyframes back that edges may reach
    frontend_radius: int = 2  # keyframes back that are always linked, one more than this
    frontend_nms: int = 1  # suppression of edges beside a chosen one
    max_factors: int = 48  # edges of the frontend's graph
    max_age: int = 25  # updates after which an edge retires
    first_updates: int = 4  # of a new keyframe
    further_updates: int = 2  # once it is known that it stays
    backend_threshold: float = 22.0
    backend_radius: int = 2
    backend_nms: int = 3
    backend_steps: tuple[int, ...] = (7, 12)  # updates of each global bundle adjustment at the end
    backend_every: int = 0  # keyframes between global bundle adjustments on the way; 0: only at the end


PRESETS = {
    "demo": Preset(),
    "tum": Preset(
        stride=2,
        filter_threshold=1.75,
        warmup=12,
        beta=0.6,
        keyframe_threshold=2.25,
        frontend_threshold=12.0,
        backend_threshold=15.0,
    ),
    # as the GO-SLAM family runs Replica
    "replica": Preset(
        stride=1,
        filter_threshold=1.75,
        beta=0.6,
        keyframe_threshold=2.25,
        frontend_threshold=25.0,
        frontend_window=50,
        frontend_radius=1,
        max_factors=75,
        max_age=50,
        backend_threshold=25.0,
        backend_every=50,
    ),
}


def preset(name: str) -> Preset:
    """Raises ValueError for an unknown name."""
    if name not in PRESETS:
        raise ValueError(f"no preset {name!r} of DROID-SLAM: give one of {', '.join(PRESETS)}")
    return PRESETS[name]


__all__ = ["AREA", "PRESETS", "Preset", "preset"]
