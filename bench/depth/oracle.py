"""What poses and images allow: how well neighboring keyframes' true depths, and matches of their images, fit together.

No stereo takes part. Where poses do not fit images or true depths, no stereo that uses them can be right:
carried: true depths of the neighbors that stereo would choose, projected into the reference, the nearest where several
fall (occlusion) and of all neighbors the one that fits best; the part within 5 % of the reference's true depth.
matches: corners of the reference, found in each neighbor by the tracker's Lucas-Kanade, and how far they lie from
where true depth and pose put them; the part off the epipolar line is what no depth explains.
triangulated: the depth at which all matches of a corner fit best; the part within 5 % of the true depth.
Corners lie away from jumps of depth, and matching and triangulation start from the truth: these are upper bounds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bench.depth.data import Scene
from bench.table import Row
from mvsgs_core.fusion.backend import NativeFusionBackend
from mvsgs_core.fusion.interface import FuseOptions
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth, depth_maps
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig
from mvsgs_core.mvs.hypotheses import SearchRange
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.mvs.stereo import StereoDepth, empty_depth
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import LucasKanade
from mvsgs_core.warp import apply_warp, relative_warp

INLIER = 0.05  # relative error, as in the goals of real scenes
CORNERS = 600  # a keyframe
JUMP, AROUND = 0.05, 17  # relative difference of depth, within as many pixels as the matches' window has
NOISE = 0.5  # pixels, of a match; those farther off count less (Cauchy)


class _Choice(Cascade):
    """The cascade's choice of neighbors, without its stereo."""

    def _estimate(
        self, reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange, effort: int
    ) -> StereoDepth:
        return empty_depth(reference.size)


@dataclass(frozen=True)
class Oracle:
    """Of a scene; ratios, one array a keyframe, are of depth to the true one."""

    carried: list[np.ndarray]  # (P,) pixels that a neighbor's true depth reaches
    triangulated: list[np.ndarray]  # (C,) corners that were found in a neighbor
    off: np.ndarray  # (M,) pixels from a match to where true depth and pose put it
    across: np.ndarray  # (M,) pixels from a match to the epipolar line


def oracle_rows(scene: Scene, area: int, tracked: bool) -> list[Row]:
    """`tracked`: as the benchmark scores the tracker's depths, each map is aligned by its median ratio to the truth."""
    found = oracle(scene, area)
    title = f"oracle, {scene.name}"
    kinds = {"true depths carried over": found.carried, "matches triangulated": found.triangulated}
    rows = [
        Row(f"{title}: {what}, within 5 %{', aligned' if align and not tracked else ''}", within(ratios, align))
        for align in ((True,) if tracked else (False, True))
        for what, ratios in kinds.items()
    ]
    return [
        *rows,
        Row(f"{title}: matches off true depth and pose, median", float(np.median(found.off)), "px"),
        Row(f"{title}: matches off the epipolar line, median", float(np.median(found.across)), "px"),
    ]


def within(ratios: list[np.ndarray], align: bool) -> float:
    """Part within 5 %. `align`: each keyframe's median ratio is divided out."""
    known = [r / np.median(r) if align else r for r in ratios if r.size]
    return float(np.mean(np.abs(np.concatenate(known) - 1.0) < INLIER))


def oracle(scene: Scene, area: int) -> Oracle:
    """Raises ValueError where no keyframe with true depth has a neighbor to compare with."""
    carried, triangulated, distances = [], [], []
    for view, truth, neighbors in _references(scene, area):
        carried.append(_carried(view, truth, neighbors))
        corners, inverse = _corners(view, truth)
        matches = [_Match.of(view, neighbor, corners, inverse) for neighbor, _ in neighbors]
        found = np.any([match.good for match in matches], axis=0)
        triangulated.append((inverse / _triangulated(matches, inverse))[found])
        distances += [match.distances(inverse) for match in matches]
    if not any(r.size for r in carried) or not any(r.size for r in triangulated):
        raise ValueError(f"{scene.name}: no keyframe with true depth has a neighbor to compare with")
    return Oracle(carried, triangulated, *np.concatenate(distances, axis=1))


_Neighbor = tuple[StereoKeyframe, np.ndarray | None]


def _references(scene: Scene, area: int) -> Iterator[tuple[StereoKeyframe, np.ndarray, list[_Neighbor]]]:
    """Keyframes with true depth, and the neighbors that stereo would match them with, with theirs."""
    cascade = _Choice(CascadeConfig(area=area))
    chosen = [one for view in scene.views for one in cascade.add(view)] + list(cascade.flush())
    known = {view.index: (view, truth) for view, truth in zip(scene.views, scene.truths, strict=True)}
    for one in chosen:
        truth = known[one.view.index][1]
        if truth is not None and (truth > 0).any() and one.neighbors:
            yield one.view, truth, [known[index] for index in one.neighbors]


def _warp(reference: StereoKeyframe, neighbor: StereoKeyframe) -> np.ndarray:
    return relative_warp(reference.intrinsics, reference.world_from_cam, neighbor.intrinsics, neighbor.world_from_cam)


def _carried(view: StereoKeyframe, truth: np.ndarray, neighbors: list[_Neighbor]) -> np.ndarray:
    """Ratio of depth (P,) of the neighbor that fits best; P is 0 where no neighbor has true depth."""
    maps = [_with_depth(neighbor, depth) for neighbor, depth in neighbors if depth is not None]
    if not maps:
        return np.ones(0)
    all_of_it = FuseOptions(violation=1.0, min_neighbor_confidence=0.0)
    splatted = NativeFusionBackend(1).splat(depth_maps(_with_depth(view, truth), maps), all_of_it)
    reached = (truth > 0) & (splatted > 0).any(axis=0)
    ratios = np.where(splatted > 0, splatted / np.where(truth > 0, truth, 1.0), np.inf)[:, reached]
    best = np.abs(ratios - 1.0).argmin(axis=0)
    return np.asarray(np.take_along_axis(ratios, best[None], axis=0)[0])


def _with_depth(view: StereoKeyframe, depth: np.ndarray) -> KeyframeDepth:
    return KeyframeDepth(view.index, depth, np.ones_like(depth), view.intrinsics, view.world_from_cam, view.scale)


def _corners(view: StereoKeyframe, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (C, 2) float64 of corners on smooth known depth, and their inverse depths (C,)."""
    kernel = np.ones((AROUND, AROUND), np.uint8)
    farthest = cv2.dilate(truth, kernel)
    nearest = cv2.erode(np.where(truth > 0, truth, farthest), kernel)
    smooth = (truth > 0) & (farthest < (1.0 + JUMP) * nearest)
    corners = cv2.goodFeaturesToTrack(_image(view).gray, CORNERS, 0.01, 4, mask=smooth.astype(np.uint8))
    if corners is None:
        return np.zeros((0, 2)), np.zeros(0)
    pixels = corners.reshape(-1, 2).astype(np.float64)
    u, v = np.rint(pixels).astype(int).T
    return pixels, 1.0 / truth[v, u].astype(np.float64)


def _image(view: StereoKeyframe) -> TrackingImage:
    return TrackingImage(view.index, 0.0, np.clip(np.rint(view.gray(1) + 128.0), 0, 255).astype(np.uint8))


@dataclass(frozen=True)
class _Match:
    """A reference's corners in one neighbor."""

    warp: np.ndarray  # (12,)
    corners: np.ndarray  # (C, 2) pixels in the reference
    seen: np.ndarray  # (C, 2) pixels in the neighbor
    good: np.ndarray  # (C,) bool: found

    @staticmethod
    def of(view: StereoKeyframe, neighbor: StereoKeyframe, corners: np.ndarray, inverse: np.ndarray) -> _Match:
        warp = _warp(view, neighbor)
        x, y, z = apply_warp(warp, corners[:, 0], corners[:, 1], inverse)
        guess = np.where(z[:, None] > 0, np.stack([x, y], axis=1), np.nan)
        found = LucasKanade().match(_image(view), _image(neighbor), corners, guess)
        return _Match(warp, corners, found.target, found.alive)

    def error(self, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Seen minus predicted pixel (C, 2), 0 where not found, and the change of the predicted one with `inverse`."""
        x, y, z = apply_warp(self.warp, self.corners[:, 0], self.corners[:, 1], inverse)
        place = np.stack([x, y], axis=1)
        moves = (self.warp[9:11] - place * self.warp[11]) / np.where(z > 1e-9, z, 1.0)[:, None]
        return np.where(self.good[:, None], self.seen - place, 0.0), moves

    def distances(self, inverse: np.ndarray) -> np.ndarray:
        """(2, M) pixels: to the predicted place and to the epipolar line, of the corners that were found."""
        error, moves = (part[self.good] for part in self.error(inverse))
        normal = np.stack([-moves[:, 1], moves[:, 0]], axis=1) / np.linalg.norm(moves, axis=1, keepdims=True)
        return np.stack([np.linalg.norm(error, axis=1), np.abs((error * normal).sum(axis=1))])


def _triangulated(matches: list[_Match], inverse: np.ndarray) -> np.ndarray:
    """Inverse depths (C,) by Gauss-Newton from the true ones."""
    found = inverse.copy()
    for _ in range(10):
        normal, right = np.full(len(inverse), 1e-12), np.zeros(len(inverse))
        for match in matches:
            error, moves = match.error(found)
            weight = match.good / (NOISE**2 + (error**2).sum(axis=1))
            normal += weight * (moves**2).sum(axis=1)
            right += weight * (moves * error).sum(axis=1)
        found = np.clip(found + right / normal, 0.25 * inverse, 4.0 * inverse)
    return found
