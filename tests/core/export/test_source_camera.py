"""The camera that took a stream: what a source and the tracker say of it, in cameras.json, and what cannot be."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mvsgs_core.datasets.lens import Lens, guess_lens
from mvsgs_core.export.cameras import read_cameras, read_source_camera, write_cameras
from mvsgs_core.export.source_camera import (
    FACTOR,
    LENS,
    PHOTOGRAPHS,
    SourceCamera,
    camera_of,
    camera_values,
    lens_values,
    source_camera,
)
from tests.support.tiny_map import cameras_around, save_cameras

PHONE = Lens((1400.0, 1410.0, 959.5, 539.5), (1080, 1920), (0.1, -0.05, 0.0, 0.001))
GUESS = guess_lens((480, 640))


def said(lens: Lens, factor: Any = None, **tracker: Any) -> dict[str, Any]:
    counts = {} if factor is None else {FACTOR: factor}
    return {
        "dataset": {"values": {LENS: lens_values(lens)}},
        "tracker": {"counts": counts, "values": tracker},
        "odd": 1,
    }


def test_a_calibration_that_was_given_is_kept_whatever_the_tracker_says() -> None:
    camera = source_camera(said(PHONE, factor=1.3, focal_sigma_percent=1.0, readout_time=0.018))
    assert camera == SourceCamera(PHONE, "given", None, "", 0.018)
    assert camera.text() == (
        "focal length 1400.0 and 1410.0 px at 1920x1080, given; distortion 0.1, -0.05, 0, 0.001; "
        "rolling shutter of 18.0 ms"
    )


def test_a_guess_takes_the_trackers_factor_and_says_how_sure_it_is() -> None:
    camera = source_camera(said(GUESS, factor=1.25, focal_sigma_percent=1.5))
    assert camera is not None
    assert camera.origin == "estimated"
    assert camera.lens.intrinsics == pytest.approx((1.25 * GUESS.intrinsics[0],) * 2 + GUESS.intrinsics[2:])
    assert camera.focal_sigma == pytest.approx(0.015)
    assert camera.readout_time is None
    assert "px at 640x480, estimated, give or take 1.5 %" in camera.text()
    assert "doubtful" not in camera.text()


@pytest.mark.parametrize("lens", [GUESS, replace(GUESS, guessed=False)])
def test_photographs_have_the_lens_that_they_were_mapped_with(lens: Lens) -> None:
    """Their tracker starts from what is given, too."""
    camera = source_camera(said(lens, **{PHOTOGRAPHS: [0.9, -0.08, 0.01]}))
    assert camera is not None
    assert (camera.origin, camera.focal_sigma, camera.doubt) == ("estimated", None, "")
    fx, fy, cx, cy = GUESS.intrinsics
    assert camera.lens.intrinsics == pytest.approx((0.9 * fx, 0.9 * fy, cx, cy))
    assert camera.lens.distortion == (-0.08, 0.01, 0.0, 0.0)
    assert camera_of(camera_values(camera)) == camera
    given = source_camera(said(PHONE, **{PHOTOGRAPHS: [0.9, -0.08, 0.01]}))
    assert given is not None
    assert given.lens.distortion == PHONE.distortion  # that was taken out of them before


def test_a_guess_that_stays_one_is_doubted() -> None:
    kept = source_camera(said(GUESS, factor=1.0, focal_doubt="it can't be told"))
    assert kept is not None
    assert (kept.origin, kept.lens.intrinsics, kept.doubt) == ("guessed", GUESS.intrinsics, "it can't be told")
    untested = source_camera(said(GUESS))
    assert untested is not None
    assert untested.text().endswith("guessed; doubtful: it is a guess that nothing has tested")


@pytest.mark.parametrize(
    "statistics",
    [
        {}, {"dataset": {"values": {}}}, {"dataset": 3}, said(GUESS, factor="x", focal_sigma_percent=1.0),
        said(GUESS, factor=float("nan"), focal_sigma_percent=1.0), said(GUESS, readout_time=-1.0),
        said(GUESS, **{PHOTOGRAPHS: [1.0, 2.0]}), said(GUESS, **{PHOTOGRAPHS: 3}),
        {"dataset": {"values": {LENS: {**lens_values(PHONE), "intrinsics": [1.0, 2.0]}}}},
        {"dataset": {"values": {LENS: {**lens_values(PHONE), "size": [1e400, 2]}}}},
    ],
)  # fmt: skip
def test_what_is_no_camera_is_none(statistics: dict[str, Any]) -> None:
    assert source_camera(statistics) is None


@pytest.mark.parametrize(("reads_columns", "line"), [(False, "row"), (True, "column")])
def test_a_camera_may_be_held_in_any_way(reads_columns: bool, line: str) -> None:
    camera = source_camera(said(PHONE, readout_time=-0.018, reads_columns=reads_columns))
    assert camera == SourceCamera(PHONE, "given", None, "", -0.018, reads_columns=reads_columns)
    assert camera.text().endswith(f"rolling shutter of 18.0 ms, the last {line} first")
    assert camera_of(camera_values(camera)) == camera


def test_it_comes_back_from_cameras_json_and_is_no_keyframe(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    bent = {"radial_k1": -0.1, "radial_k1_sigma": 0.02}
    camera = source_camera(said(GUESS, factor=1.25, focal_sigma_percent=1.5, readout_time=0.02, **bent))
    assert camera is not None
    assert camera.radial == (-0.1, 0.02)
    assert "radial distortion -0.100, give or take 0.020, left in" in camera.text()
    write_cameras(path, cameras_around([0.0, 1.0]), camera)
    assert read_source_camera(path) == camera
    assert len(read_cameras(path)) == 2
    save_cameras(tmp_path, [0.0])
    assert read_source_camera(path) is None


@pytest.mark.parametrize("change", [{"origin": "x"}, {"intrinsics": [1, 2, 3]}, {"focal_sigma": -1}, {"radial": [1]}])
def test_damage_is_named(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "cameras.json"
    write_cameras(path, cameras_around([0.0]), SourceCamera(PHONE, "given"))
    content = json.loads(path.read_text())
    content["camera"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"cameras\.json: `camera`: "):
        read_source_camera(path)


def test_what_is_missing_is_named() -> None:
    values = camera_values(SourceCamera(PHONE, "given"))
    for name in values:
        with pytest.raises(ValueError, match=f"^`{name}` is missing$"):
            camera_of({key: value for key, value in values.items() if key != name})
