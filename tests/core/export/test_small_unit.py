"""A map in a large unit, of which a room is a thousandth, is exported as in any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.colmap import write_colmap
from mvsgs_core.export.mesh import write_mesh
from mvsgs_core.export.render_path import frames_along
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_map import INTRINSICS, SIZE, cameras_around, final_map

UNIT = 1e-4
WHOLE = final_map(1, opacity=0.98, origin=np.zeros(3))
SMALL = WHOLE.scaled(UNIT)


def cameras(scale: float) -> Cameras:
    found = cameras_around([0.4, 0.6])
    poses = found.world_from_cam.copy()
    poses[:, :3, 3] = scale * (poses[:, :3, 3] - cameras_around([0.4]).world_from_cam[0, :3, 3])
    return replace(found, world_from_cam=poses)


def test_a_video_shows_the_same() -> None:
    shown = [list(frames_along(m, cameras(s).world_from_cam, INTRINSICS, SIZE)) for m, s in ((WHOLE, 1), (SMALL, UNIT))]
    assert np.mean(shown[0]) > 50
    assert np.abs(np.subtract(*np.array(shown, dtype=int))).max() <= 2


def test_a_model_knows_as_well_what_is_hidden(tmp_path: Path) -> None:
    """Half of it: each wall stands there a second time, behind itself."""
    values = {name: torch.cat([value, value]) for name, value in WHOLE.splats.tensors().items()}
    values["means"][len(WHOLE.splats) :] *= 1.5
    doubled = replace(WHOLE, splats=Splats(**values), anchors=np.tile(WHOLE.anchors, 2))
    whole = write_colmap(tmp_path / "whole", doubled, cameras(1.0), observations=True)
    small = write_colmap(tmp_path / "small", doubled.scaled(UNIT), cameras(UNIT), observations=True)
    assert whole.observations > 500
    assert abs(small.observations / whole.observations - 1.0) < 0.02


def test_a_mesh_is_as_large(tmp_path: Path) -> None:
    whole, _ = write_mesh(tmp_path / "whole.ply", WHOLE, cameras(1.0), voxel=0.05)
    small, _ = write_mesh(tmp_path / "small.ply", SMALL, cameras(UNIT), voxel=0.05)
    assert abs(small / whole - 1.0) < 0.1
