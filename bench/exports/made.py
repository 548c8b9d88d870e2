"""The map that is exported, all that is made of it, and our own renders of it."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.table import Row, at_least
from mvsgs_core import Mapping
from mvsgs_core.datasets import open_dataset
from mvsgs_core.export.__main__ import main as export
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.command_line import input_arguments, known_cameras, read_map
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.render_path import main as render_path
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.interface import as_bytes

SPLATS = ("gaussians.ply", "map.splat", "map.spz")
MESHES = ("mesh.ply", "mesh.obj", "mesh.glb", "mesh.stl", "mesh.off")


@dataclass(frozen=True)
class Made:
    """A folder with all exports of one map."""

    folder: Path
    map: Snapshot
    cameras: Cameras
    counts: dict[str, int]  # of splats, triangles, cameras or frames, by the export's name
    views: tuple[int, ...]  # keyframes that are compared, as places among them

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.cameras.sizes[0].tolist()
        return height, width

    @property
    def intrinsics(self) -> np.ndarray:
        """(4,) of the virtual camera: the keyframes' focal length, looking through the middle of its image."""
        fx = float(self.cameras.intrinsics[0][0])
        height, width = self.size
        return np.array([fx, fx, (width - 1) / 2, (height - 1) / 2])

    def pose(self, view: int) -> np.ndarray:
        return np.asarray(self.cameras.world_from_cam[view])

    def render(self, view: int) -> np.ndarray:
        """(H, W, 3) uint8 of the map as we render it."""
        return rendered(self.map, self.pose(view), self.intrinsics, self.size)


@dataclass(frozen=True)
class Opened:
    """What a program made of an export. None: it does not say, or does not render."""

    export: str
    program: str
    count: int | None = None
    psnr: float | None = None  # dB against our render of the map, mean over the views
    note: str = ""  # why it could not be opened; empty where it was

    def rows(self, expected: int | None, goal: float | None) -> list[Row]:
        """expected: how many there are in the export; goal: dB that a render of it reaches."""
        name = f"{self.export} in {self.program}"
        if self.note:
            return [Row(f"{name}: opened", f"no: {self.note}", "", "yes", False)]
        rows = [Row(f"{name}: opened", "yes", "", "yes", True)]
        if self.count is not None:
            rows.append(Row(f"{name}: count", f"{self.count} of {expected}", "", "equal", self.count == expected))
        if self.psnr is not None:
            name = f"{name}: PSNR to our render"
            if math.isinf(self.psnr):
                rows.append(
                    Row(name, "the same", "", "" if goal is None else f">= {goal:g}", None if goal is None else True)
                )
            else:
                rows.append(Row(name, self.psnr, "dB") if goal is None else at_least(name, self.psnr, "dB", goal))
        return rows


def load(path: Path) -> tuple[Snapshot, Cameras | None]:
    """A map's .ply and the cameras beside it. Raises OSError, ValueError for damaged files."""
    parser = argparse.ArgumentParser()
    input_arguments(parser)
    options = parser.parse_args([str(path)])
    snapshot, _ = read_map(options)
    return snapshot, known_cameras(options)


def rendered(shown: Snapshot, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) uint8 by our rasterizer, in the colors of the mean camera, over black, as other programs show it."""
    return as_bytes(replace(shown, background=None).render(pose, intrinsics, size, near=near_plane(shown, pose)).color)


def make(folder: Path, quick: bool) -> Made:
    """Maps the synthetic room and exports it. Raises RuntimeError where an export fails."""
    height, width = (96, 128) if quick else (180, 240)
    frames = open_dataset("synthetic", frames=30 if quick else 60, size=[height, width])
    words = [f"mapper.iterations={8 if quick else 40}", f"mapper.refinement={60 if quick else 400}", "device=cpu"]
    with Mapping(*words, intrinsics=next(iter(frames)).intrinsics) as mapping:
        for item in frames:
            mapping.add(item.image, item.timestamp)
    mapping.save(folder)
    given, cameras = load(folder / "map.ply")
    assert cameras is not None
    map_file = str(folder / "map.ply")
    _run(export, map_file, str(folder / "gaussians.ply"), "--fold")
    for name in (*SPLATS[1:], *MESHES[1:]):
        _run(export, map_file, str(folder / name))
    _run(export, map_file, str(folder / "mesh.ply"), "--mesh")
    _run(export, map_file, str(folder / "colmap"), "--images", "--observations")
    _run(export, map_file, str(folder / "transforms.json"))
    _run(render_path, map_file, str(folder / "trajectory.txt"), str(folder / "flight.mp4"), "--frames", "20")
    counts = dict.fromkeys(SPLATS, len(given.splats)) | dict.fromkeys(("colmap", "transforms.json"), len(cameras))
    counts |= {"flight.mp4": 20, "mesh": _triangles(folder / "mesh.off")}
    last = len(cameras) - 1
    return Made(folder, given, cameras, counts, (last // 2,) if quick else (0, last // 2, last))


def _run(program: object, *words: str) -> None:
    assert callable(program)
    if program(list(words)) != 0:
        raise RuntimeError(f"the export failed: {' '.join(words)}")


def _triangles(path: Path) -> int:
    """Of an .off file, whose second line says it."""
    words = path.read_text().split()
    return int(words[2])


__all__ = ["MESHES", "SPLATS", "Made", "Opened", "load", "make", "rendered"]
