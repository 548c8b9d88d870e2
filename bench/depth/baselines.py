"""What stereo is measured against, of OpenCV pieces only: a plain plane sweep, and SGBM on a rectified pair."""

from __future__ import annotations

import cv2
import numpy as np

from bench.depth.data import Scene
from bench.depth.run import Run, score
from bench.table import Row, at_least
from mvsgs_core import camera, geometry
from mvsgs_core.mvs.hypotheses import SearchRange
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.warp import relative_warp


def baseline_rows(scene: Scene, found: Run, align: bool) -> list[Row]:
    """Outliers at equal completeness against a plain plane sweep; both figures against SGBM."""
    by_index = {v.index: v for v in scene.views}
    plain: list[np.ndarray] = []
    unsure: list[np.ndarray] = []
    pair: list[np.ndarray] = []
    for one in found.stereo:
        if one.search is None or not one.neighbors:
            empty = np.zeros(one.view.size, np.float32)
            for maps in (plain, unsure, pair):
                maps.append(empty)
            continue
        neighbors = [by_index[i] for i in one.neighbors]
        depth, confidence = plane_sweep(one.view, neighbors, one.search, hypotheses=96)
        plain.append(depth)
        unsure.append(confidence)
        pair.append(sgbm(one.view, neighbors[0], one.search))
    ours = score([f.depth for f in found.fused], scene, align)
    stereo_only = [np.where(d.result.confidence >= 0.7, d.result.depth, 0).astype(np.float32) for d in found.stereo]
    alone = score(stereo_only, scene, align)
    known = [(t > 0) if t is not None else np.zeros_like(d, bool) for t, d in zip(scene.truths, plain, strict=True)]
    pooled = np.concatenate([c[k] for c, k in zip(unsure, known, strict=True)])
    rows = []
    for name, reference in (("filtered", ours), ("stereo alone, confidence 0.7", alone)):
        limit = np.quantile(pooled, 1.0 - reference.completeness)
        cut = [np.where(c >= limit, d, 0).astype(np.float32) for c, d in zip(unsure, plain, strict=True)]
        swept = score(cut, scene, align)
        ratio = (1.0 - swept.inliers) / max(1.0 - reference.inliers, 1e-6)
        rows.append(Row(f"{scene.name}: plane sweep inliers, as complete as {name}", swept.inliers))
        rows.append(at_least(f"{scene.name}: outliers of the plane sweep over ours, {name}", ratio, "", 2.0))
    pairwise = score(pair, scene, align)
    rows.append(Row(f"{scene.name}: SGBM inliers", pairwise.inliers))
    rows.append(Row(f"{scene.name}: SGBM completeness", pairwise.completeness))
    better = alone.inliers > pairwise.inliers and alone.completeness > pairwise.completeness
    text = f"{alone.inliers:.3f}, {alone.completeness:.3f}"
    rows.append(Row(f"{scene.name}: stereo alone, inliers and completeness", text, "", "better than SGBM", better))
    return rows


def plane_sweep(
    reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange, hypotheses: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and confidence (H, W): fronto-parallel planes, box ZNCC 7x7, mean over views, winner takes all.

    Confidence: how much better the best is than the best hypothesis at least two steps away.
    """
    gray = reference.gray(1)
    size = (gray.shape[1], gray.shape[0])
    window = (7, 7)
    mean = cv2.blur(gray, window)
    variance = cv2.blur(gray * gray, window) - mean * mean
    inverse_depths = np.linspace(search.low, search.high, hypotheses)
    costs = np.zeros((hypotheses, *gray.shape), dtype=np.float32)
    for neighbor in neighbors:
        warp = relative_warp(
            reference.intrinsics, reference.world_from_cam, neighbor.intrinsics, neighbor.world_from_cam
        )
        for k, w in enumerate(inverse_depths):
            homography = warp[:9].reshape(3, 3).copy()
            homography[:, 2] += w * warp[9:]
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            sample = cv2.warpPerspective(neighbor.gray(1), homography, size, flags=flags)
            sample_mean = cv2.blur(sample, window)
            sample_variance = cv2.blur(sample * sample, window) - sample_mean * sample_mean
            covariance = cv2.blur(gray * sample, window) - mean * sample_mean
            norm = np.sqrt(np.maximum(variance * sample_variance, 0.0) + 4.0)
            costs[k] += np.clip(1.0 - covariance / norm, 0.0, 1.0) / len(neighbors)
    best = costs.argmin(axis=0)
    lowest = np.take_along_axis(costs, best[None], axis=0)[0]
    apart = np.abs(np.arange(hypotheses)[:, None, None] - best[None]) >= 2
    second = np.where(apart, costs, np.inf).min(axis=0)
    return (1.0 / inverse_depths[best]).astype(np.float32), np.clip(second - lowest, 0.0, 1.0)


def sgbm(reference: StereoKeyframe, neighbor: StereoKeyframe, search: SearchRange) -> np.ndarray:
    """Depth (H, W) in the reference by StereoSGBM on the rectified pair; 0 where it gives none."""
    height, width = reference.size
    relative = geometry.inverse(neighbor.world_from_cam) @ reference.world_from_cam
    ours, theirs = camera.matrix(reference.intrinsics), camera.matrix(neighbor.intrinsics)
    no_distortion = np.zeros(5)
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        ours, no_distortion, theirs, no_distortion, (width, height), relative[:3, :3], relative[:3, 3:], alpha=0
    )
    maps = [
        cv2.initUndistortRectifyMap(k, no_distortion, r, p, (width, height), cv2.CV_32FC1)
        for k, r, p in ((ours, r1, p1), (theirs, r2, p2))
    ]
    images = [
        cv2.remap(np.clip(view.gray(1) + 128, 0, 255).astype(np.uint8), *m, cv2.INTER_LINEAR)
        for view, m in zip((reference, neighbor), maps, strict=True)
    ]
    vertical = abs(p2[1, 3]) > abs(p2[0, 3])
    if vertical:
        images = [np.ascontiguousarray(i.T) for i in images]
    shift = float(p2[1, 3] if vertical else p2[0, 3])
    if shift > 0:  # the neighbor lies on the other side: matched from it, or mirrored
        images = [np.ascontiguousarray(i[:, ::-1]) for i in images]
    lowest = max(0, int(abs(shift) * search.low) - 1)
    wanted = int(np.ceil((abs(shift) * search.high - lowest + 2) / 16)) * 16
    count = min(max(16, wanted), (images[0].shape[1] - lowest - 1) // 16 * 16)
    if count < 16:  # a camera that moved forward: rectification stretches the images, and OpenCV would throw
        return np.zeros((height, width), np.float32)
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest, numDisparities=count, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=50, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(images[0], images[1]).astype(np.float32) / 16.0
    if shift > 0:
        disparity = disparity[:, ::-1]
    if vertical:
        disparity = disparity.T
    good = disparity > max(lowest, 0.5)
    rectified = np.where(good, abs(shift) / np.where(good, disparity, 1.0), 0.0)
    return _unrectify(rectified, reference, r1, p1)


def _unrectify(
    depth: np.ndarray, reference: StereoKeyframe, rotation: np.ndarray, projection: np.ndarray
) -> np.ndarray:
    """Depth of the rectified camera, looked up from the reference's pixels (nearest; z along the reference's axis)."""
    height, width = reference.size
    u, v = camera.pixel_grid(height, width)
    fx, fy, cx, cy = reference.intrinsics
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
    turned = rays @ rotation.T
    x = projection[0, 0] * turned[..., 0] / turned[..., 2] + projection[0, 2]
    y = projection[1, 1] * turned[..., 1] / turned[..., 2] + projection[1, 2]
    found = cv2.remap(depth.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST)
    return (found / turned[..., 2]).astype(np.float32)
