"""The synthetic scenes: exact geometry, determinism, anti-aliasing, texture without repeats, every switch."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvsgs_core import camera, geometry
from mvsgs_core.datasets import check, open_dataset
from mvsgs_core.datasets.synthetic import FPS, Synthetic
from mvsgs_core.datasets.write_tum import main as write_tum
from mvsgs_core.scene import materials
from mvsgs_core.scene.difficulties import Difficulties
from mvsgs_core.scene.furniture import table, vase
from mvsgs_core.scene.lighting import Lighting, RectLight
from mvsgs_core.scene.lit import lit
from mvsgs_core.scene.patches import Patch, quad
from mvsgs_core.scene.renderer import SceneRenderer
from mvsgs_core.scene.room import HEIGHT, LENGTH, WIDTH

pytestmark = pytest.mark.slow

LIGHT = Lighting(texel=0.1, rects=(RectLight((0, 0, 3), (0, 1, 0), (1, 0, 0), (5, 5, 5)),), zenith=(0.4, 0.5, 0.6))


@pytest.fixture(scope="module", params=["room", "aerial"])
def sequence(request: pytest.FixtureRequest) -> Synthetic:
    return Synthetic(scene=request.param)


def room(**options: Any) -> Synthetic:
    return Synthetic(**{"size": (120, 160), **options})


def test_item_has_the_declared_types_and_times(sequence: Synthetic) -> None:
    item = sequence[3]
    assert len(sequence) == 120
    assert (item.index, item.timestamp) == (3, 3 / FPS)
    assert item.image.shape == (240, 320, 3)
    assert item.image.dtype == np.uint8
    assert item.depth is not None
    assert item.depth.shape == (240, 320)
    assert item.depth.dtype == np.float32
    assert item.world_from_cam is not None
    assert item.world_from_cam.dtype == np.float64
    rotation = item.world_from_cam[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def warp(sequence: Synthetic, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame j as seen from i: (error of gray levels, relative error of depth), of pixels that land inside."""
    a, b = sequence[i], sequence[j]
    assert a.depth is not None
    assert b.depth is not None
    relative = geometry.inverse(b.world_from_cam) @ a.world_from_cam
    points = camera.unproject(a.depth, a.intrinsics) @ relative[:3, :3].T + relative[:3, 3]
    at = camera.project(points, b.intrinsics).astype(np.float32)
    h, w = a.depth.shape
    inside = (at[..., 0] > 0) & (at[..., 0] < w - 1) & (at[..., 1] > 0) & (at[..., 1] < h - 1)
    color = cv2.remap(b.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(float)
    depth = cv2.remap(b.depth, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    error = np.abs(color - a.image).mean(axis=-1)
    return error[inside], np.abs(depth / points[..., 2] - 1.0)[inside]


def test_one_frame_warped_with_depth_and_poses_is_the_other(sequence: Synthetic) -> None:
    error, off = warp(sequence, 40, 46)
    assert np.mean(off < 0.01) > 0.85  # the rest is hidden in the other view, or on an edge
    visible = off < 0.01
    assert np.median(error[visible]) < 4.0
    assert error[visible].mean() < 0.5 * error_of_wrong_pose(sequence)


def error_of_wrong_pose(sequence: Synthetic) -> float:
    a, b = sequence[40], sequence[46]
    return float(np.abs(a.image.astype(float) - b.image).mean())


def test_depth_is_exact_at_pixel_centers() -> None:
    # A tilted plane z = 3 + 0.5 x - 0.25 y before a camera at the origin.
    corners = np.array([[[x, y, 3 + 0.5 * x - 0.25 * y] for x in (-5.0, 5.0)] for y in (-5.0, 5.0)])
    scene = SceneRenderer(lit([Patch(corners, np.full((8, 8, 3), 128, np.uint8))], LIGHT))
    intrinsics = np.array([100.0, 110.0, 30.2, 21.7])
    depth = scene.render(np.eye(4), intrinsics, (45, 63)).depth
    u, v = camera.pixel_grid(45, 63)
    x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
    np.testing.assert_allclose(depth, 3.0 / (1.0 - 0.5 * x + 0.25 * y), rtol=3e-6)


def test_nearest_hit_is_that_of_all_triangles_tried_one_by_one() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform((-2, -2, 2), (2, 2, 6), (400, 1, 3))
    corners = places + rng.normal(0, 0.4, (400, 3, 3))
    corners[::7] = corners[0]  # coincident ones can't be parted by any plane
    paper = np.full((4, 4, 3), 128, np.uint8)
    patches = [Patch(np.stack([[a, b], [c, b + c - a]]), paper) for a, b, c in corners]
    intrinsics = np.array([40.0, 40.0, 19.5, 14.5])
    depth = SceneRenderer(lit(patches, LIGHT)).render(np.eye(4), intrinsics, (30, 40)).depth
    u, v = camera.pixel_grid(30, 40)
    rays = np.stack([(u - 19.5) / 40.0, (v - 14.5) / 40.0, np.ones_like(u)], axis=-1)
    expected = np.full((30, 40), np.inf)
    for a, b, c in corners:
        normal = np.cross(b - a, c - a)
        z = (a @ normal) / (rays @ normal)
        along = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), (rays * z[..., None] - a).reshape(-1, 3).T)[0]
        inside = ((along >= 0) & (along <= 1)).all(axis=0).reshape(30, 40)  # a parallelogram: the patch's two triangles
        expected = np.where(inside & (z > 0) & (z < expected), z, expected)
    expected[np.isinf(expected)] = 0.0
    assert np.mean(np.abs(depth - expected) < 1e-4) > 0.995  # a ray along an edge may fall on either side
    assert 0.1 < np.mean(expected > 0) <= 1.0


def test_corner_that_is_not_finite_is_refused() -> None:
    points = quad((0, 0, 1), (1, 0, 0), (0, 1, 0))
    points[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        lit([Patch(points, np.zeros((4, 4, 3), np.uint8))], LIGHT)


def test_camera_axes_are_right_down_forward() -> None:
    white, dark = np.full((4, 4, 3), 255, np.uint8), np.full((4, 4, 3), 20, np.uint8)
    right_low = Patch(quad((0.2, 0.2, 2), (0.5, 0, 0), (0, 0.5, 0)), white, emission=1.0)
    rest = Patch(quad((-5, -5, 4), (10, 0, 0), (0, 10, 0)), dark, emission=1.0)
    scene = SceneRenderer(lit([right_low, rest], LIGHT))
    color = scene.render(np.eye(4), np.array([60, 60, 31.5, 23.5]), (48, 64)).color
    rows, columns = np.nonzero(color[..., 0] > 0.9)
    assert rows.min() > 23.5
    assert columns.min() > 31.5
    assert rows.size > 150


def test_points_lie_in_the_room_and_the_image_is_upright() -> None:
    sequence = room(frames=400, stride=57)
    for item in sequence:
        assert item.depth is not None
        assert item.world_from_cam is not None
        points = camera.unproject(item.depth, item.intrinsics) @ item.world_from_cam[:3, :3].T
        points += item.world_from_cam[:3, 3]
        assert points.min() > -1e-3
        assert (points.reshape(-1, 3).max(axis=0) < np.array([WIDTH, LENGTH, HEIGHT]) + 1e-3).all()
        assert item.world_from_cam[2, 1] < -0.9


def test_same_frame_whatever_was_read_before() -> None:
    options: dict[str, Any] = {"frames": 10, "noise": 3.0, "motion_blur": 0.5, "exposure": 0.5}
    forward, alone = list(room(**options)), room(**options)[7]
    np.testing.assert_array_equal(forward[7].image, alone.image)
    np.testing.assert_array_equal(forward[7].depth, alone.depth)


def test_build_does_not_depend_on_threads_and_changes_with_the_seed() -> None:
    pose = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, -2.0], [0, -1.0, 0, 0.8], [0, 0, 0, 1.0]])
    intrinsics = np.array([80.0, 80.0, 39.5, 29.5])

    def view(seed: int, threads: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        scene = SceneRenderer(lit([*table(rng), *vase(rng, 1.1)], LIGHT, seed, threads))
        return scene.render(pose, intrinsics, (60, 80), threads=threads).color

    np.testing.assert_array_equal(view(0, 1), view(0, 2))
    assert np.abs(view(0, 1) - view(1, 1)).mean() > 1e-3


def test_image_is_anti_aliased(sequence: Synthetic) -> None:
    pose = sequence[20].world_from_cam
    assert pose is not None
    small, large = (120, 160), (960, 1280)
    intrinsics = camera.scale_intrinsics(sequence.intrinsics, (240, 320), small)
    image = sequence.render(pose, intrinsics, small)[0].astype(float)
    fine, _ = sequence.render(pose, camera.scale_intrinsics(intrinsics, small, large), large)
    truth = camera.resize_image(fine, small).astype(float)
    assert 10 * np.log10(255**2 / np.mean((image - truth) ** 2)) > 27.0


def test_texture_does_not_repeat(sequence: Synthetic) -> None:
    """SIFT features of a view have no twins elsewhere in it, where those of a wall of equal tiles do."""

    def twins(image: np.ndarray) -> float:
        keypoints, descriptors = cv2.SIFT_create(600).detectAndCompute(image, None)
        at = np.array([k.pt for k in keypoints])
        distance = np.linalg.norm(descriptors[:, None] - descriptors[None], axis=-1)
        distance[np.linalg.norm(at[:, None] - at[None], axis=-1) < 15] = np.inf
        return float(np.mean(distance.min(axis=1) < 150.0))

    view = sequence[60].image
    assert twins(view) < 0.05
    tile = cv2.resize(view, (80, 60), interpolation=cv2.INTER_AREA)
    assert twins(np.tile(tile, (4, 4, 1))) > 0.5


def test_every_part_of_the_view_has_texture(sequence: Synthetic) -> None:
    gray = cv2.cvtColor(sequence[30].image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    blocks = gray.reshape(12, 20, 16, 20).std(axis=(1, 3))
    assert np.mean(blocks > 2.0) > 0.9


def test_path_is_smooth_keeps_clear_and_does_not_repeat(sequence: Synthetic) -> None:
    item = sequence[0]
    long = Synthetic(scene=sequence.stage.name, frames=2000, size=(48, 64))
    for n in range(0, 2000, 40):
        _, depth = long.render(long.path.pose(n), long.intrinsics, long.size)
        assert depth.min() > (0.25 if sequence.stage.name == "room" else 20.0)
    poses = np.array([long.path.pose(n) for n in range(2000)])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.linalg.norm(geometry.so3_log(geometry.inverse(poses[:-1]) @ poses[1:])[:, :], axis=1)
    assert item.depth is not None
    focal, depth_scale = item.intrinsics[0], float(np.median(item.depth))
    flow = focal * (steps / depth_scale + turns)  # an upper bound, pixels at 320x240
    assert 2.0 < np.median(flow) < 9.0
    assert flow.max() < 16.0
    apart = np.linalg.norm(poses[:100, None, :3, 3] - poses[None, 300:, :3, 3], axis=-1)
    assert np.median(apart.min(axis=1)) > 0.5 * np.median(steps)


def test_loop_comes_back(sequence: Synthetic) -> None:
    loop = Synthetic(scene=sequence.stage.name, frames=300, size=(48, 64), loop=True)
    assert loop.warnings == []
    np.testing.assert_allclose(loop.path.pose(300), loop.path.pose(0), atol=1e-9)
    poses = np.array([loop.path.pose(n)[:3, 3] for n in range(300)])
    assert np.linalg.norm(poses - poses[0], axis=1).max() > 1.5
    assert Synthetic(frames=60, size=(48, 64), loop=True).warnings


def test_start_stop_stride_choose_frames() -> None:
    part = room(frames=50, start=4, stop=20, stride=5)
    assert [item.timestamp for item in part] == [n / FPS for n in (4, 9, 14, 19)]
    assert [item.index for item in part] == [0, 1, 2, 3]
    np.testing.assert_array_equal(part[1].image, room(frames=50)[9].image)


def test_render_agrees_with_the_items_at_any_origin_and_scale() -> None:
    plain, moved = room(), room(origin=1e6, scale=1e3)
    a, b = plain[10], moved[10]
    np.testing.assert_array_equal(a.image, b.image)
    assert a.depth is not None
    assert b.depth is not None
    assert a.world_from_cam is not None
    assert b.world_from_cam is not None
    np.testing.assert_allclose(b.depth, 1e3 * a.depth, rtol=1e-6)
    np.testing.assert_allclose(b.world_from_cam[:3, 3], 1e3 * a.world_from_cam[:3, 3] + 1e6, rtol=1e-12)
    image, depth = moved.render(b.world_from_cam, b.intrinsics, moved.size)
    np.testing.assert_allclose(depth, b.depth, rtol=1e-5)
    assert np.abs(image.astype(float) - b.image).mean() < 0.05


def test_textureless_walls_are_bare() -> None:
    def corners(sequence: Synthetic) -> int:
        gray = cv2.cvtColor(sequence[0].image, cv2.COLOR_RGB2GRAY)[20:100, 100:240]
        return len(cv2.FastFeatureDetector_create(12).detect(gray, None))

    assert corners(room(size=(240, 320), textureless=4)) < 0.5 * corners(room(size=(240, 320)))


def test_pure_rotation_keeps_the_camera_center_and_turns() -> None:
    poses = np.array([room(pure_rotation=40, pure_rotation_start=10).path.pose(n) for n in range(70)])
    np.testing.assert_allclose(poses[10:50, :3, 3], np.broadcast_to(poses[10, :3, 3], (40, 3)), atol=1e-12)
    turn = geometry.so3_log(geometry.inverse(poses[10:50]) @ poses[10])
    assert np.degrees(np.linalg.norm(turn, axis=1).max()) > 15
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps[:10].min() > 0.002
    turns = np.linalg.norm(geometry.so3_log(geometry.inverse(poses[:-1]) @ poses[1:]), axis=1)
    assert np.degrees(turns.max()) < 6.0  # and no jerk where it begins and ends


def test_rest_gives_equal_frames() -> None:
    still = room(rest=5, rest_start=8)
    np.testing.assert_array_equal(still[8].image, still[12].image)
    assert (still[8].image != still[14].image).any()


def test_covered_lens_is_black_but_the_truth_is_known() -> None:
    covered = room(covered=3, covered_start=5)
    assert [int(covered[n].image.max()) > 30 for n in (4, 5, 7, 8)] == [True, False, False, True]
    assert covered[6].depth is not None
    assert covered[6].depth.min() > 0


@pytest.mark.parametrize("shutter", [{}, {"rolling_shutter": 0.8}, {"rolling_columns": 0.8}, {"motion_blur": 0.8}])
def test_jump_leaves_a_part_of_the_path_out(shutter: dict[str, float]) -> None:
    jump, whole = room(jump=30, jump_start=10, **shutter), room(**shutter)
    np.testing.assert_array_equal(jump[9].image, whole[9].image)
    np.testing.assert_array_equal(jump[10].image, whole[40].image)


def test_drop_loses_frames_and_their_time_stamps() -> None:
    dropped = room(frames=100, drop=0.3)
    assert 55 < len(dropped) < 85
    steps = np.diff([dropped.numbers[i] / FPS for i in range(len(dropped))])
    assert steps.max() > 1.5 / FPS
    assert dropped.numbers == room(frames=100, drop=0.3).numbers


def test_motion_blur_smooths_along_the_motion() -> None:
    def sharpness(sequence: Synthetic) -> float:
        return float(cv2.Laplacian(cv2.cvtColor(sequence[20].image, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())

    assert sharpness(room(size=(240, 320), motion_blur=1.0)) < 0.6 * sharpness(room(size=(240, 320)))


def test_exposure_drifts() -> None:
    drift, steady = room(exposure=1.0, stride=8), room(stride=8)
    ratio = [a.image.mean() / b.image.mean() for a, b in zip(drift, steady)]
    assert max(ratio) > 1.15
    assert min(ratio) < 0.85


def test_noise_has_the_asked_strength_and_grows_with_light() -> None:
    noisy, clean = room(noise=5.0)[3].image.astype(float), room()[3].image.astype(float)
    error, mid = noisy - clean, (clean > 100) & (clean < 156)
    assert np.std(error[mid]) == pytest.approx(5.0, rel=0.1)
    assert np.std(error[clean < 30]) < 0.8 * np.std(error[(clean > 180) & (clean < 235)])
    assert (room(noise=5.0)[4].image != room(noise=5.0)[3].image).any()


def test_gloss_adds_light_that_moves_with_the_view() -> None:
    glossy, dull = (room(gloss=g)[0] for g in (3.0, 0.0))
    added = glossy.image.astype(float) - dull.image
    assert added.min() >= 0
    assert added.max() > 20
    np.testing.assert_array_equal(glossy.depth, dull.depth)


def test_moving_object_is_seen_in_image_and_depth_and_moves() -> None:
    moving, still = room(moving_object=2.0, frames=90), room(frames=90)
    places = []
    for n in range(0, 90, 9):
        a, b = moving[n], still[n]
        assert a.depth is not None
        assert b.depth is not None
        nearer = a.depth < b.depth - 1e-4
        assert (a.depth <= b.depth + 1e-4).all()
        if nearer.sum() > 30:
            assert np.abs(a.image[nearer].astype(float) - b.image[nearer]).mean() > 8
            places.append(np.argwhere(nearer).mean(axis=0))
    assert len(places) >= 3
    assert np.ptp(places, axis=0).max() > 10


@pytest.mark.parametrize(
    "options",
    [{"nois": 3}, {"scene": "moon"}, {"noise": -1}, {"scale": 0.0}, {"textureless": 5}, {"drop": 2}, {"frames": 0}],
)
def test_bad_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        check("synthetic", **options)  # before a run


def test_unknown_option_lists_the_valid_ones() -> None:
    with pytest.raises(ValueError) as error:
        open_dataset("synthetic", nois=3)
    assert all(f.name in str(error.value) for f in fields(Difficulties))


def test_tum_layout_read_back(tmp_path: Path) -> None:
    write_tum([str(tmp_path / "room"), "--frames", "6", "--size", "120", "160", "stride=2"])
    read = list(open_dataset("tum", path=tmp_path / "room"))
    original = list(room(frames=6, stride=2))
    assert len(read) == len(original) == 3
    for a, b in zip(read, original):
        assert a.timestamp == pytest.approx(b.timestamp)
        np.testing.assert_allclose(a.intrinsics, b.intrinsics)
        np.testing.assert_array_equal(a.image, b.image)
        assert a.depth is not None
        assert b.depth is not None
        assert a.world_from_cam is not None
        assert b.world_from_cam is not None
        np.testing.assert_allclose(a.depth, b.depth, atol=1.01e-4)
        np.testing.assert_allclose(a.world_from_cam, b.world_from_cam, atol=1e-7)
    with pytest.raises(SystemExit):
        write_tum([str(tmp_path / "room"), "--frames", "1"])


def test_tum_layout_refuses_depth_that_does_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        write_tum([str(tmp_path / "far"), "--frames", "1", "--size", "48", "64", "scale=100"])
    assert "choose scale" in capsys.readouterr().err


def test_materials_paint_every_size() -> None:
    rng = np.random.default_rng(0)
    paints = [
        materials.plaster(rng, (200, 190, 180)),
        materials.wood(rng, (90, 60, 30), (200, 150, 90)),
        materials.fabric(rng, (90, 60, 30), (20, 60, 90)),
        materials.masonry(rng, [(100, 50, 40), (180, 100, 70)], (170, 160, 150)),
        materials.marbled(rng, [(10, 20, 30), (200, 210, 220), (90, 90, 20)]),
    ]
    for paint in paints:
        for size in ((0.01, 0.3), (0.3, 0.01), (0.4, 0.5)):
            texture = paint(*size)
            assert texture.dtype == np.uint8
            assert texture.shape[2] == 3
            assert min(texture.shape[:2]) >= 4
