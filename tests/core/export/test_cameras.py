"""cameras.json: what the mapper saw, read back to the bit, and refused where it is not that."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvsgs_core.export.cameras import Cameras, read_cameras, write_cameras
from mvsgs_core.mapping.checkpoints.results import cameras_of
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def cameras(count: int = 3) -> Cameras:
    rng = np.random.default_rng(0)
    return Cameras(
        keyframes=7 * np.arange(count),
        timestamps=np.array([0.1, np.nan, 1.0 / 3.0])[:count],
        world_from_cam=np.array([pose_on_arc(t) for t in np.linspace(0, 1, count)]).reshape(count, 4, 4),
        intrinsics=rng.uniform(20, 30, (count, 4)),
        sizes=np.tile(np.array([[24, 32]]), (count, 1)),
        exposures=rng.normal(size=(count, 3, 4)),
        vignetting=np.array([-0.3, 0.1, -1.0 / 30.0]),
    )


@pytest.mark.parametrize("count", [0, 3])
def test_cameras_come_back_to_the_bit(tmp_path: Path, count: int) -> None:
    write_cameras(tmp_path / "cameras.json", cameras(3))
    write_cameras(tmp_path / "cameras.json", cameras(count))  # takes the other's place
    again = read_cameras(tmp_path / "cameras.json")
    for name, value in vars(cameras(count)).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
        assert getattr(again, name).dtype == value.dtype
    assert [path.name for path in tmp_path.iterdir()] == ["cameras.json"]


def test_a_file_without_vignetting_is_as_ever_and_some_of_the_cameras_have_that_of_all(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.json", replace(cameras(), vignetting=None))
    assert "vignetting" not in (tmp_path / "cameras.json").read_text()
    assert read_cameras(tmp_path / "cameras.json").vignetting is None
    some = cameras().chosen(slice(1, None))
    assert some.keyframes.tolist() == [7, 14]
    np.testing.assert_array_equal(some.vignetting, cameras().vignetting)


def test_a_map_knows_its_cameras_at_the_size_of_the_images_also_where_these_are_gone() -> None:
    mapper = OnlineMapper(MapperConfig(max_pixels=12 * 16, max_keyframes=2, window=1, iterations=2, device="cpu"))
    views = [rgbd_keyframe(5 * k, pose_on_arc(k / 3), (24, 32), origin=100.0) for k in range(4)]
    for view in views:
        mapper.add_keyframe(view)
    assert any(not view.has_image for view in mapper.views)
    found = cameras_of(mapper.snapshot(), mapper.views)
    assert found.keyframes.tolist() == [0, 5, 10, 15]
    np.testing.assert_allclose(found.world_from_cam, [view.world_from_cam for view in views], atol=1e-12)
    np.testing.assert_array_equal(found.intrinsics, [view.intrinsics for view in views])
    assert found.sizes.tolist() == [[24, 32]] * 4
    assert np.isnan(found.timestamps).all()
    assert found.vignetting is None
    mapper.photometry.vignetting = np.array([-0.5, 0.25, 0.0])
    np.testing.assert_array_equal(cameras_of(mapper.snapshot(), mapper.views).vignetting, [-0.5, 0.25, 0.0])


def changed(**changes: Any) -> dict[str, Any]:
    keyframe = {
        "index": 0, "timestamp": 0.0, "world_from_cam": np.eye(4).tolist(), "intrinsics": [1, 1, 0, 0], "size": [2, 2],
        "exposure": np.eye(3, 4).tolist(),
    }  # fmt: skip
    return {"format": "mvsgs cameras", "version": 1, "keyframes": [keyframe | changes]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "no cameras.json"),
        ("[" * 100000, "no cameras.json"),
        ("[]", "no cameras.json of this program"),
        (json.dumps({"format": "mvsgs cameras", "version": 2}), "version 2: this program reads 1"),
        (json.dumps({"format": "mvsgs cameras", "version": 1, "keyframes": [3]}), "list of objects"),
        (json.dumps(changed(intrinsics=[1, 1, 0])), "keyframe 0 has no `intrinsics` of 4"),
        (json.dumps(changed(intrinsics=[0, 1, 0, 0])), "must be positive"),
        (json.dumps(changed(size=[0, 2])), "must be positive"),
        (json.dumps(changed(index=None)), "keyframe 0 has no `index` of 1"),
        (json.dumps(changed(index=10**400)), "keyframe 0 has no `index` of 1"),
        (json.dumps(changed(world_from_cam=[[1]])), "`world_from_cam` of 4 x 4"),
        (json.dumps(changed(exposure="abc")), "`exposure` of 3 x 4"),
        (json.dumps(changed(intrinsics=[float("nan"), 1, 0, 0])), "`intrinsics` of 4 finite"),
        (json.dumps(changed() | {"vignetting": [0.1, 0.2]}), "`vignetting` must be 3 finite numbers"),
        (json.dumps(changed() | {"vignetting": [0.1, 0.2, float("inf")]}), "`vignetting` must be 3 finite numbers"),
        (json.dumps(changed() | {"vignetting": "none"}), "`vignetting` must be 3 finite numbers"),
    ],
)
def test_a_file_that_is_something_else_is_refused_with_the_reason(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_cameras(tmp_path / "cameras.json")
