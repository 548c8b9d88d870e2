"""Which keyframes a reference is matched with: enough baseline, enough overlap, a similar viewing direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.setting_ranges import above, at_least, within
from mvsgs_core.warp import apply_warp, relative_warp


@dataclass(frozen=True)
class NeighborConfig:
    """How neighbors are scored; angles are between the viewing rays at the scene's median depth."""

    count: int = 4  # views
    best_angle: float = 7.0  # degrees of parallax that score 1
    angle_below: float = 4.0  # degrees, width of the score below that
    angle_above: float = 12.0  # degrees, width above
    min_angle: float = 0.4  # degrees: less gives no depth
    min_overlap: float = 0.3  # part of the reference that the neighbor sees
    turn: float = 30.0  # degrees between the optical axes that halve the score
    zoom: float = 0.2  # logarithm of how much larger a point's surroundings are in one of both: the score's width

    def __post_init__(self) -> None:
        at_least(self, count=1, best_angle=0, min_angle=0)
        above(self, angle_below=0, angle_above=0, turn=0, zoom=0)
        within(self, min_overlap=(0, 1))


@dataclass(frozen=True)
class Neighbor:
    view: StereoKeyframe
    angle: float  # degrees of parallax
    overlap: float  # 0 to 1
    score: float


def score_neighbor(
    reference: StereoKeyframe, other: StereoKeyframe, inverse_depths: np.ndarray, config: NeighborConfig
) -> Neighbor:
    """Baseline, overlap and turn of one candidate; score 0 if it fails a limit. `inverse_depths` (K,): typical ones."""
    warp = relative_warp(reference.intrinsics, reference.world_from_cam, other.intrinsics, other.world_from_cam)
    height, width = reference.size
    u, v, w = np.meshgrid(
        np.linspace(0, width - 1, 7), np.linspace(0, height - 1, 7), inverse_depths.astype(np.float64), indexing="ij"
    )
    x, y, z = apply_warp(warp, u, v, w)
    oh, ow = other.size
    seen = (z > 0) & (x >= 0) & (x <= ow - 1) & (y >= 0) & (y <= oh - 1)
    overlap = float(np.mean(seen))
    angle = _median_angle(reference, other, u[seen], v[seen], w[seen])
    zoom = float(np.median(np.abs(np.log(z[seen])))) if seen.any() else 0.0
    turned = float(
        np.degrees(np.arccos(np.clip(reference.world_from_cam[:3, 2] @ other.world_from_cam[:3, 2], -1.0, 1.0)))
    )
    if angle < config.min_angle or overlap < config.min_overlap:
        return Neighbor(other, angle, overlap, 0.0)
    width_of_score = config.angle_below if angle < config.best_angle else config.angle_above
    by_angle = np.exp(-0.5 * ((angle - config.best_angle) / width_of_score) ** 2)
    by_turn = 1.0 / (1.0 + (turned / config.turn) ** 2)
    by_zoom = np.exp(-0.5 * (zoom / config.zoom) ** 2)
    return Neighbor(other, angle, overlap, float(by_angle * by_turn * by_zoom * overlap) + 1e-6)


def _median_angle(
    reference: StereoKeyframe, other: StereoKeyframe, u: np.ndarray, v: np.ndarray, inverse_depth: np.ndarray
) -> float:
    """Degrees between both cameras' rays to points of the reference that both see; 0 where there are none.

    The middle of the image says nothing: where the camera moves forward, it is what has no parallax at all.
    """
    if not len(u):
        return 0.0
    fx, fy, cx, cy = reference.intrinsics
    here = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) / inverse_depth[:, None]
    moved = reference.world_from_cam[:3, :3].T @ (other.world_from_cam[:3, 3] - reference.world_from_cam[:3, 3])
    there = here - moved
    across = np.linalg.norm(np.cross(here, there), axis=-1)
    return float(np.degrees(np.median(np.arctan2(across, np.einsum("ij,ij->i", here, there)))))


def select_neighbors(
    reference: StereoKeyframe, candidates: list[StereoKeyframe], inverse_depths: np.ndarray, config: NeighborConfig
) -> list[Neighbor]:
    """Up to `config.count` neighbors, best first. Half of them from each side in time where these score at all well,

    because what one side does not see, behind an edge, the other often does.
    """
    scored = [score_neighbor(reference, c, inverse_depths, config) for c in candidates if c.index != reference.index]
    usable = sorted((n for n in scored if n.score > 0), key=lambda n: (-n.score, n.view.index))
    if not usable:
        return []
    limit = 0.3 * usable[0].score
    good = [n for n in usable if n.score >= limit]
    half = config.count // 2
    before = [n for n in good if n.view.index < reference.index][:half]
    after = [n for n in good if n.view.index > reference.index][: config.count - half]
    chosen = before + after
    for neighbor in usable:
        if len(chosen) >= config.count:
            break
        if neighbor not in chosen:
            chosen.append(neighbor)
    return sorted(chosen, key=lambda n: (-n.score, n.view.index))
