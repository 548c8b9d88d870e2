"""Replica (Straub et al. 2019) as NICE-SLAM rendered it, and other sets in that layout."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.files import Layout, natural_order, read_rows
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import is_rigid
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record

LAYOUT = Layout(
    "Replica (NICE-SLAM layout)",
    "a folder such as room0 with results/frame000000.jpg, results/depth000000.png, traj.txt (a 4x4 camera to world a "
    "line) and, in it or beside it, cam_params.json",
    "the Replica.zip that https://github.com/cvg/nice-slam names in scripts/download_replica.sh",
)
_PUBLISHED = Lens((600.0, 600.0, 599.5, 339.5), (680, 1200))
_DEPTH_PER_METER = 6553.5
_FRAME_RATE = 30.0  # the set has no timestamps


@dataset
@dataclass(kw_only=True, eq=False)
class Replica(ImageSequence):
    """A room of Replica. Raises FileNotFoundError and ValueError, which say what was expected."""

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any((path / "results").glob("frame*.*"))

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        images = [p for p in (folder / "results").glob("frame*.*") if re.search(r"[0-9]", p.stem)]
        images.sort(key=lambda p: natural_order(p.name))
        if not images:
            raise LAYOUT.missing(f"{folder / 'results'} has no frame000000.jpg")
        published, per_meter = _camera(folder)
        lens = self._lens(images, published)
        poses, notes = _poses(folder / "traj.txt")
        self.warnings += notes
        records = []
        for image in images:
            digits = re.sub(r"[^0-9]", "", image.stem)
            number = int(digits)
            pose = poses[number] if number < len(poses) else None
            records.append(Record(number / _FRAME_RATE, image, lens, pose, image.with_name(f"depth{digits}.png")))
        missing = sum(record.world_from_cam is None for record in records)
        if missing and len(poses):
            self.warnings.append(f"traj.txt has no pose for {missing} of {len(records)} frames")
        return Found(records, DepthFormat(per_meter))


def _camera(folder: Path) -> tuple[Lens, float]:
    """The lens and how many counts of a depth map are a meter."""
    for path in (folder / "cam_params.json", folder.parent / "cam_params.json"):
        if path.is_file():
            with reading(path, "must hold camera: w, h, fx, fy, cx, cy, scale"):
                c = json.loads(path.read_bytes())["camera"]
                fx, fy, cx, cy, scale = (float(c[name]) for name in ("fx", "fy", "cx", "cy", "scale"))
                if not (math.isfinite(scale) and scale > 0):
                    raise ValueError(f"scale = {scale} counts of depth are no meter")
                return Lens((fx, fy, cx, cy), (int(c["h"]), int(c["w"]))), scale
    return _PUBLISHED, _DEPTH_PER_METER


def _poses(path: Path) -> tuple[list[np.ndarray | None], list[str]]:
    """world_from_cam by frame number, None where a line is no pose: not finite, or no rotation."""
    if not path.is_file():
        return [], [f"{path.name} is missing: the trajectory is not scored"]
    values = read_rows(path, (16, 4), "a 4x4 camera to world")
    if values.size == 0:
        return [], [f"{path.name} is empty: the trajectory is not scored"]
    return [pose if is_rigid(pose) else None for pose in values.reshape(-1, 4, 4)], []
