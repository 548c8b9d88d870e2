"""The readers on real sequences: counts, cameras, and conventions that the images themselves confirm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.geometry import inverse
from tests.support.shared_data import shared
from tests.support.warping import epipolar_error, photometric_error

Y_UP = np.diag([1.0, -1.0, 1.0, 1.0])

# format, folder, (first, second) frames to compare, frames in all, options
WITH_DEPTH = [
    ("tum", "tum_fr1_xyz", (18, 24), 160, {}),
    ("tum", "tum_fr1_xyz", (66, 72), 160, {}),
    ("seven_scenes", "seven_scenes_redkitchen", (98, 108), 300, {}),
    ("seven_scenes", "seven_scenes_redkitchen", (130, 140), 300, {}),
    ("icl_nuim", "icl_nuim_of_kt0", (20, 30), 51, {}),
    ("icl_nuim", "icl_nuim_of_kt0", (30, 40), 51, {}),
    ("replica", "replica/room0_20f", (4, 12), 20, {"size": (340, 600)}),
]


def two_frames(name: str, folder: str, pair: tuple[int, int], **options: Any) -> tuple[Item, Item]:
    first, second = pair
    path = shared(f"data/{folder}")
    a, b = open_dataset(name, path=path, start=first, stop=second + 1, stride=second - first, **options)
    return a, b


def with_poses(items: tuple[Item, Item], change: Callable[[np.ndarray], np.ndarray]) -> tuple[Item, Item]:
    a, b = items
    assert a.world_from_cam is not None
    assert b.world_from_cam is not None
    return replace(a, world_from_cam=change(a.world_from_cam)), replace(b, world_from_cam=change(b.world_from_cam))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "folder", "pair", "frames", "options"), WITH_DEPTH)
def test_depth_and_poses_predict_the_other_image(
    name: str, folder: str, pair: tuple[int, int], frames: int, options: dict[str, Any]
) -> None:
    assert len(open_dataset(name, path=shared(f"data/{folder}"))) == frames
    items = two_frames(name, folder, pair, **options)
    error = photometric_error(*items)
    # better than not moving, and than each way to get poses wrong: inverted, or with the y axis up
    wrong = {
        "still": photometric_error(items[0], items[1], items[0].world_from_cam),
        "inverted": photometric_error(*with_poses(items, inverse)),
        "y up": photometric_error(*with_poses(items, lambda pose: Y_UP @ pose @ Y_UP)),
    }
    assert error < 0.6 * min(wrong.values()), (error, wrong)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "folder", "pair", "limit"),
    [
        ("tum", "tum_fr1_xyz", (2, 8), 1.0),
        ("seven_scenes", "seven_scenes_redkitchen", (0, 20), 1.0),
        ("icl_nuim", "icl_nuim_of_kt0", (20, 30), 0.4),
        ("replica", "replica/room0_20f", (4, 12), 0.3),
        ("images", "fox", (0, 1), 0.6),
        ("images", "strecha/fountain-P11", (2, 3), 0.3),
        ("images", "strecha/Herz-Jesus-P8", (2, 3), 0.3),
    ],
)
def test_matches_lie_on_epipolar_lines(name: str, folder: str, pair: tuple[int, int], limit: float) -> None:
    items = two_frames(name, folder, pair, size=640 * 480)
    error = epipolar_error(*items)
    inverted = epipolar_error(*items, mirror=True)
    assert error < limit
    assert error < 0.1 * inverted


@pytest.mark.slow
def test_the_color_camera_of_seven_scenes_is_not_the_published_one() -> None:
    pairs = [(start, start + 20) for start in (0, 60)]
    ours = [two_frames("seven_scenes", "seven_scenes_redkitchen", pair) for pair in pairs]
    published = [two_frames("seven_scenes", "seven_scenes_redkitchen", pair, registered=False) for pair in pairs]
    assert np.mean([epipolar_error(*p) for p in ours]) < 0.8 * np.mean([epipolar_error(*p) for p in published])
    # and depth that is not registered to color predicts colors worse
    depth_pairs = [(start, start + 10) for start in (98, 130)]
    registered = [two_frames("seven_scenes", "seven_scenes_redkitchen", pair) for pair in depth_pairs]
    as_published = [two_frames("seven_scenes", "seven_scenes_redkitchen", p, registered=False) for p in depth_pairs]
    assert np.mean([photometric_error(*p) for p in registered]) < np.mean([photometric_error(*p) for p in as_published])


@pytest.mark.parametrize(
    ("folder", "frames", "shape"),
    [("fox", 25, (1920, 1080)), ("strecha/fountain-P11", 11, (800, 1200)), ("strecha/Herz-Jesus-P8", 8, (800, 1200))],
)
def test_photo_sets_with_poses(folder: str, frames: int, shape: tuple[int, int]) -> None:
    sequence = open_dataset("images", path=shared(f"data/{folder}"), size=list(shape))
    assert len(sequence) == frames
    item = next(iter(sequence))
    assert item.image.shape == (*shape, 3)
    assert item.world_from_cam is not None
    assert sequence.warnings == []


def test_aerial_photographs_have_a_focal_length_in_exif() -> None:
    sequence = open_dataset("images", path=shared("data/aerial_caliterra"))
    assert len(sequence) == 24
    # Canon SX260: 4.5 mm behind a sensor 6.17 mm wide (the maker's data sheet), 1200 pixels
    assert next(iter(sequence)).intrinsics[0] == pytest.approx(4.5 / 6.17 * 1200, rel=0.01)
    assert "EXIF" in sequence.warnings[0]


def test_the_stress_sequence_is_recognized_as_freiburg3() -> None:
    sequence = open_dataset("tum", path=shared("data/tum_fr3_structure_notexture_far"))
    items = list(sequence)
    assert len(items) == 30
    np.testing.assert_allclose(items[0].intrinsics, [535.4, 539.2, 320.1, 247.6])
    assert sum(item.depth is not None for item in items) == 5
    assert all(item.world_from_cam is not None for item in items)
