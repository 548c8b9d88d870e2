"""Where a map has no splat it shows the mean color of its keyframes, and says so to all who render it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.evaluation.scoring import ScoredFrame, render_frame
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.mapping.background import Background
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.photometry import IDENTITY
from nodes.splat_map import snapshot_of, splat_map
from tests.support.small_maps import CONFIG, FINE, mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

GAIN = np.array([[1.4, 0, 0, 0.02], [0, 1.2, 0, 0.0], [0, 0, 0.7, 0.01]], np.float32)
HOLE = slice(20, 44)  # columns without depth
UNFILLED = replace(CONFIG, insertion=replace(FINE, doubtful=False))


def arc() -> list[RGBDKeyframe]:
    return [rgbd_keyframe(5 * k, pose_on_arc(t)) for k, t in enumerate((0.4, 0.5, 0.6))]


def with_hole(view: RGBDKeyframe) -> RGBDKeyframe:
    depth = view.depth.copy()
    depth[:, HOLE] = 0.0
    return replace(view, depth=depth)


def test_it_is_the_mean_of_the_images_where_they_count() -> None:
    views = arc()
    mask = np.ones(views[0].image.shape[:2], bool)
    mask[:, :32] = False
    mapper = mapped([replace(views[0], mask=mask), views[1]], replace(CONFIG, iterations=1, refinement=0))
    colors = [views[0].image[mask].mean(axis=0), views[1].image.reshape(-1, 3).mean(axis=0)]
    np.testing.assert_allclose(mapper.trainer.background, np.mean(colors, axis=0) / 255.0, atol=1e-6)
    assert Background().color is None
    nothing = replace(mapper.views[0], mean_color=np.zeros(3))
    assert Background([nothing]).color is None
    np.testing.assert_allclose(Background([nothing, mapper.views[1]]).color, colors[1] / 255.0, atol=1e-6)


def test_exposures_are_undone_and_follow_corrections() -> None:
    plain = mapped(arc(), replace(CONFIG, iterations=1, refinement=0))
    known = plain.trainer.background
    assert known is not None
    told = [replace(view, exposure=GAIN) for view in arc()]
    mapper = mapped(told, plain.config)
    found = mapper.trainer.background
    assert found is not None
    np.testing.assert_allclose(GAIN[:, :3] @ found + GAIN[:, 3], known, atol=1e-5)
    # handed out, colors are those of the mean camera: here that of all keyframes
    np.testing.assert_allclose(mapper.snapshot().background, known, atol=1e-5)
    mapper.photometry.take([0, 5, 10], np.stack([IDENTITY] * 3), None, mapper.log)
    mapper.expose()
    np.testing.assert_allclose(mapper.trainer.background, known, atol=1e-6)


def test_no_splat_is_drawn_over_what_it_shows_already() -> None:
    """As a sky without depth: behind black, splats beside it grow over it."""
    view = with_hole(arc()[1])
    image = view.image.copy()
    image[:, HOLE] = np.delete(image, HOLE, axis=1).mean(axis=(0, 1)).round()
    mapper = mapped([replace(view, image=image)], replace(UNFILLED, iterations=60))
    render, inside = mapper.render(mapper.views[0]), slice(HOLE.start + 4, HOLE.stop - 4)
    assert render.opacity[:, inside].mean() < 0.1
    assert render.opacity[:, : HOLE.start - 8].mean() > 0.8
    sky = torch.tensor(image[0, 30] / 255.0).float()
    torch.testing.assert_close(render.color[:, inside].mean((0, 1)), sky, atol=0.02, rtol=0)


def test_what_is_seen_is_opaque_all_the_same() -> None:
    """Images of about one color: over a background that is always that, splats could stay half transparent."""
    views = [replace(view, image=np.round(0.1 * view.image + 110.0).astype(np.uint8)) for view in arc()]
    insertion = InsertionConfig(price=0.005)
    mapper = mapped(views, MapperConfig(iterations=120, refinement=200, threads=1, insertion=insertion, device="cpu"))
    assert mapper.render(mapper.views[1]).opacity.mean() > 0.9


@pytest.mark.parametrize("exposed", [False, True])
def test_the_message_the_file_and_the_scores_know_of_it(tmp_path: Path, exposed: bool) -> None:
    views = [
        replace(with_hole(view), exposure=GAIN * (1.0 + 0.1 * k) if exposed else None) for k, view in enumerate(arc())
    ]
    mapper = mapped(views, UNFILLED)
    final, view = mapper.snapshot(), mapper.views[1]
    size, near = view.size, 1e-3 * mapper.frame.length
    shown = final.render(view.world_from_cam, view.intrinsics, size, near=near).color
    own = mapper.render(view).color
    if exposed:
        affine = torch.from_numpy(final.exposures[1])
        torch.testing.assert_close((shown @ affine[:, :3].T + affine[:, 3]).clamp(0, 1), own, atol=0.01, rtol=0)
    else:
        torch.testing.assert_close(shown, own, atol=2e-3, rtol=0)
    write_ply(tmp_path / "map.ply", final)
    for copy in (snapshot_of(splat_map(final, refined=True)), read_ply(tmp_path / "map.ply")):
        assert copy.background is not None
        np.testing.assert_array_equal(copy.background, final.background)
        again = copy.render(view.world_from_cam, view.intrinsics, size, near=near).color
        torch.testing.assert_close(again, shown, atol=1e-3, rtol=0)
    black = np.zeros((*size, 3), np.uint8)
    frame = ScoredFrame(
        5, True, final.relative_pose(view.world_from_cam), view.intrinsics, lambda: black, near,
        background=final.background,
    )  # fmt: skip
    np.testing.assert_allclose(
        render_frame(final.splats, final.kernel, frame, size).color, shown.clamp(0, 1), atol=1e-6
    )
