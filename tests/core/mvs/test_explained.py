"""Whether a keyframe is called explained by the map: when it is, when it is not, and never twice in a row."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np

from mvsgs_core import camera
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig
from mvsgs_core.mvs.explained import ExplainChoice, Explained, MapSight
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from tests.support.plane_scene import look, render, true_depth

SIZE = (96, 128)


def view(index: int, x: float) -> StereoKeyframe:
    pose = look(x)
    image, intrinsics = render(pose, SIZE)
    grid = (1.0 / true_depth(pose, SIZE)[4::8, 4::8]).astype(np.float32)
    return prepare_keyframe(index, image, intrinsics, pose, area=SIZE[0] * SIZE[1], scales=(1, 2), inverse_depth=grid)


def sight(index: int, x: float) -> MapSight:
    pose = look(x)
    image, intrinsics = render(pose, SIZE)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return MapSight(index, gray, true_depth(pose, SIZE).astype(np.float32), intrinsics, pose, 1.0)


def explained(*sights: MapSight) -> Explained:
    found = Explained(ExplainChoice(share=0.8, area=48 * 36))
    for one in sights:
        found.see(one)
    return found


def test_a_right_map_explains_what_it_sees_and_no_more() -> None:
    assert explained().share(view(1, 0.1)) == 0.0
    near, far = explained(sight(0, 0.0)).share(view(1, 0.05)), explained(sight(0, 0.0)).share(view(1, 1.5))
    assert near > 0.85
    assert far < near - 0.2


def test_two_sights_explain_more_than_one_and_brightness_does_not_matter() -> None:
    one, two = explained(sight(0, 0.0)), explained(sight(0, 0.0), sight(2, 1.0))
    assert two.share(view(1, 0.6)) > one.share(view(1, 0.6))
    darker = sight(0, 0.0)
    darker = replace(darker, gray=darker.gray - 30.0)
    assert abs(explained(darker).share(view(1, 0.05)) - one.share(view(1, 0.05))) < 0.05


def test_a_wrong_color_a_wrong_depth_or_another_segment_explains_nothing() -> None:
    right = sight(0, 0.0)
    reference = view(1, 0.3)
    whole = explained(right).share(reference)
    assert explained(replace(right, gray=right.gray[:, ::-1].copy())).share(reference) < 0.7 * whole
    assert explained(replace(right, depth=0.4 * right.depth)).share(reference) < 0.7 * whole
    assert explained(replace(right, segment=1)).share(reference) == 0.0


def test_a_large_render_explains_as_much_as_a_small_one() -> None:
    small = sight(0, 0.0)
    order = (2 * SIZE[1], 2 * SIZE[0])
    nearest = cv2.INTER_NEAREST
    large = replace(
        small, gray=cv2.resize(small.gray, order), depth=cv2.resize(small.depth, order, interpolation=nearest),
        intrinsics=camera.scale_intrinsics(small.intrinsics, SIZE, (2 * SIZE[0], 2 * SIZE[1])),
    )  # fmt: skip
    assert large.gray.size > 2**15  # OpenCV's limit of a row
    reference = view(1, 0.3)
    assert abs(explained(large).share(reference) - explained(small).share(reference)) < 0.05


def test_a_corrected_pose_moves_the_sight() -> None:
    off = look(0.0)
    off[0, 3] += 0.8
    found = explained(replace(sight(0, 0.0), world_from_cam=off, scale=2.0, depth=2.0 * sight(0, 0.0).depth))
    before = found.share(view(1, 0.05))
    found.move({0: (look(0.0), 1.0)})
    assert found.share(view(1, 0.05)) > max(0.85, before + 0.1)


def test_the_cascade_passes_over_every_other_explained_keyframe() -> None:
    cascade = Cascade(CascadeConfig(area=SIZE[0] * SIZE[1], threads=1))
    cascade.explained = explained(*(sight(i, 0.15 * i) for i in (0, 2, 4)))
    found = [d for i in range(5) for d in cascade.add(view(i, 0.15 * i))] + list(cascade.flush())
    passed = [d.result.counts.get("explained", 0.0) > 0 for d in found]
    assert any(passed)
    assert not any(a and b for a, b in itertools.pairwise(passed))
    for one, empty in zip(found, passed, strict=True):
        assert (one.result.depth > 0).any() != empty
        assert one.problem == ""
