"""Exports of Polycam and Record3D."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset, recognized
from mvsgs_core.geometry import quaternion_from_rotation, so3_exp
from tests.support.dataset_folders import write_image

_TURN = so3_exp(np.array([0.3, -0.2, 0.1]))  # of the camera in ARKit's axes


def _polycam(folder: Path, kind: str = "corrected_") -> None:
    write_image(folder / "thumbnail.jpg", 9, (32, 32))  # of the whole scan: none of its frames
    for i in range(3):
        write_image(folder / f"keyframes/{kind}images/10{i}.jpg", 20 + i)
        values = {f"t_{r}{c}": float(_TURN[r, c]) for r in range(3) for c in range(3)}
        values |= {"t_03": float(i), "t_13": 2.0, "t_23": 3.0, "fx": 50, "fy": 51, "cx": 32, "cy": 24}
        path = folder / f"keyframes/{kind}cameras/10{i}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(values | {"width": 64, "height": 48}))


def _record3d(folder: Path) -> None:
    w, x, y, z = quaternion_from_rotation(_TURN).tolist()
    for i in (0, 1, 2):
        write_image(folder / f"rgb/{i}.jpg", 20 + i)
    poses = [[x, y, z, w, float(i), 2.0, 3.0] for i in range(3)]
    content = {"h": 48, "w": 64, "fps": 30, "K": [50, 0, 0, 0, 51, 0, 32, 24, 1], "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(content))


@pytest.mark.parametrize("write", [_polycam, _record3d])
def test_poses_and_intrinsics(tmp_path: Path, write: object) -> None:
    assert callable(write)
    write(tmp_path)
    assert recognized(tmp_path) == ["images"]
    items = list(open_dataset("images", path=tmp_path))
    assert len(items) == 3
    for i, item in enumerate(items):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 31.5, 23.5])
        assert item.world_from_cam is not None
        np.testing.assert_allclose(item.world_from_cam[:3, 3], [i, 2, 3])
        # looks along -z of ARKit's camera, with y downward
        np.testing.assert_allclose(item.world_from_cam[:3, 2], -_TURN[:, 2], atol=1e-12)
        np.testing.assert_allclose(item.world_from_cam[:3, 1], -_TURN[:, 1], atol=1e-12)


def test_corrected_cameras_come_first(tmp_path: Path) -> None:
    _polycam(tmp_path, "")
    assert open_dataset("images", path=tmp_path).records[0].image.parent.name == "images"  # type: ignore[attr-defined]
    _polycam(tmp_path)
    sequence = open_dataset("images", path=tmp_path)
    assert sequence.records[0].image.parent.name == "corrected_images"  # type: ignore[attr-defined]


def test_record3d_says_when_its_frames_were_taken(tmp_path: Path) -> None:
    _record3d(tmp_path)
    file = tmp_path / "metadata.json"
    content = json.loads(file.read_text())

    def times(said: dict[str, object], **options: float) -> list[float]:
        file.write_text(json.dumps({key: value for key, value in content.items() if key != "fps"} | said))
        return [item.timestamp for item in open_dataset("images", path=tmp_path, **options)]

    stamps: dict[str, object] = {"fps": 60, "frameTimestamps": [700.0, 700.5, 702.0]}
    assert times(stamps) == [0.0, 0.5, 2.0]
    assert times(stamps, rate=4.0) == [0.0, 0.25, 0.5]
    assert times({"fps": 5}) == pytest.approx([0.0, 0.2, 0.4])
    assert times({}) == pytest.approx([0.0, 1 / 30, 2 / 30])
    (tmp_path / "rgb/1.jpg").unlink()
    assert times(stamps) == [0.0, 2.0]
    for wrong in ({"frameTimestamps": [1.0, 2.0]}, {"frameTimestamps": [1.0, np.nan, 2.0]}, {"fps": 0}):
        with pytest.raises(BadFileError, match=r"metadata\.json .*(of each pose one|no number of images per second)"):
            times(wrong)


def test_damaged_exports(tmp_path: Path) -> None:
    _record3d(tmp_path / "a")
    content = json.loads((tmp_path / "a/metadata.json").read_text())
    (tmp_path / "a/metadata.json").write_text(json.dumps(content | {"poses": content["poses"][:2]}))
    with pytest.raises(BadFileError, match="3 images, 2 poses"):
        open_dataset("images", path=tmp_path / "a")
    _polycam(tmp_path / "b")
    (tmp_path / "b/keyframes/corrected_cameras/101.json").write_text('{"t_00": 1}')
    with pytest.raises(BadFileError, match="no camera of Polycam's"):
        open_dataset("images", path=tmp_path / "b")


def test_another_program_has_a_metadata_json_too(tmp_path: Path) -> None:
    for i in range(2):
        write_image(tmp_path / f"rgb/{i}.jpg", 20 + i)
    (tmp_path / "metadata.json").write_text('{"device": "iPad", "fps": 30}')
    sequence = open_dataset("images", path=tmp_path)
    assert "no calibration" in sequence.warnings[0]
    assert len(list(sequence)) == 2


def test_hidden_files_of_another_disk_are_no_cameras(tmp_path: Path) -> None:
    _polycam(tmp_path)
    for path in [p for p in tmp_path.rglob("*") if p.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert len(list(open_dataset("images", path=tmp_path))) == 3
