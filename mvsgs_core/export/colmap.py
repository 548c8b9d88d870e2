"""A COLMAP text model that offline trainers read: cameras, images, and the splats' centers as points."""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mvsgs_core import atomic_file, camera, geometry
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.image_sizes import check_size
from mvsgs_core.export.keyframe_images import image_name, there
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.interface import as_bytes
from mvsgs_core.rasterizer.spherical_harmonics import to_rgb

BEHIND = 0.03  # of the rendered depth: a point farther behind the surface is hidden by it
HEADS = {  # the first lines of our files, which COLMAP's own begin otherwise
    "cameras.txt": "# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    "images.txt": "# Image list: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; "
    "then POINTS2D[] (X, Y, POINT3D_ID)",
    "points3D.txt": "# 3D point list: POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] (IMAGE_ID, POINT2D_IDX)",
}


@dataclass(frozen=True)
class Written:
    images: int
    points: int
    observations: int  # 0 where none were asked for
    left_out: int = 0  # keyframes without an image


def write_colmap(
    folder: Path,
    final: Snapshot,
    cameras: Cameras,
    images: Path | None = None,
    observations: bool = False,
    min_opacity: float = 0.1,
) -> Written:
    """`folder`/sparse/0 with cameras.txt, images.txt and points3D.txt, and `folder`/images with what they refer to.

    images: a folder with the keyframes' images, as mapper.save_images=true writes them, to be copied; None: the model
    only has their names, which are the same. Those of a stream before, whose images another run has, are left out then.
    observations: each point's track names the images in which it is seen, at the pixels it projects to: they are of
    this map, not measured. Hidden is what lies `BEHIND` the rendered depth. Splats of less than `min_opacity` make no
    point. COLMAP's pixel (0, 0) is the corner of the first pixel, ours its center. An earlier export there is replaced.
    Raises ValueError where an image of this stream is missing, or one is of another size than its camera, and for a
    folder with another program's model, or with images that would be replaced.
    """
    given = len(cameras)
    ours = _is_ours(folder / "sparse" / "0")
    if images is not None:
        cameras = cameras.chosen((cameras.keyframes >= 0) | there(images, cameras.keyframes))
        if given and not len(cameras):
            raise ValueError(f"no keyframe's image is in {images}: run with mapper.save_images=true")
        _copy(images, folder / "images", cameras, replacing=ours)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    lenses, lens_of = np.unique(np.hstack([cameras.sizes, cameras.intrinsics]), axis=0, return_inverse=True)
    text = [HEADS["cameras.txt"]]
    for k, (height, width, fx, fy, cx, cy) in enumerate(lenses.tolist()):
        text.append(f"{k + 1} PINHOLE {width:.0f} {height:.0f} {fx!r} {fy!r} {cx + 0.5!r} {cy + 0.5!r}")
    _write(model / "cameras.txt", text)
    solid = torch.sigmoid(final.splats.opacity_logits).numpy() >= min_opacity
    means = final.splats.means.numpy()[solid].astype(np.float64)
    tracks = _Tracks(len(means))
    text = [HEADS["images.txt"]]
    for k in range(len(cameras)):
        cam_from_world = geometry.inverse(cameras.world_from_cam[k])
        numbers = [*geometry.quaternion_from_rotation(cam_from_world[:3, :3]), *cam_from_world[:3, 3]]
        name = image_name(int(cameras.keyframes[k]))
        text.append(f"{k + 1} {' '.join(repr(float(value)) for value in numbers)} {lens_of.flat[k] + 1} {name}")
        seen, pixels = _seen(final, means, cameras, k) if observations else _NOTHING
        tracks.add(k + 1, seen)
        points2d = zip((pixels + 0.5).tolist(), (seen + 1).tolist(), strict=True)
        text.append(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in points2d))
    _write(model / "images.txt", text)
    colors = as_bytes(to_rgb(final.splats.sh[:, 0]))[solid]
    world = (means + final.origin).tolist()
    text = [HEADS["points3D.txt"]]
    for k, ((x, y, z), (r, g, b), track) in enumerate(zip(world, colors.tolist(), tracks, strict=True)):
        text.append(" ".join([f"{k + 1} {x!r} {y!r} {z!r} {r} {g} {b} 0", *track]))
    _write(model / "points3D.txt", text)
    return Written(len(cameras), len(means), tracks.count, given - len(cameras))


_NOTHING = np.zeros(0, dtype=np.int64), np.zeros((0, 2))


class _Tracks:
    """By point, where it is seen: `IMAGE_ID POINT2D_IDX` of each image."""

    def __init__(self, points: int) -> None:
        self._points = points
        self._entries: list[np.ndarray] = []  # (M, 3) point, image, row among the image's points

    def add(self, image: int, seen: np.ndarray) -> None:
        """Points (M,) in the order in which the image lists them."""
        self._entries.append(np.stack([seen, np.full(len(seen), image), np.arange(len(seen))], axis=1))

    @property
    def count(self) -> int:
        return sum(len(entries) for entries in self._entries)

    def __iter__(self) -> Iterator[list[str]]:
        entries = np.concatenate(self._entries) if self._entries else np.zeros((0, 3), dtype=np.int64)
        entries = entries[np.argsort(entries[:, 0], kind="stable")]
        ends = np.searchsorted(entries[:, 0], np.arange(self._points), side="right").tolist()
        begin = 0
        for end in ends:
            yield [f"{image} {row}" for _, image, row in entries[begin:end].tolist()]
            begin = end


def _seen(final: Snapshot, means: np.ndarray, cameras: Cameras, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (M,) of `means` (N, 3), relative to the origin, that camera k sees, and where (M, 2), in our pixels."""
    height, width = cameras.sizes[k].tolist()
    pose = cameras.world_from_cam[k]
    render = final.render(pose, cameras.intrinsics[k], (height, width), near=near_plane(final, pose))
    surface = torch.where(render.opacity >= 0.5, render.depth, torch.inf).numpy()
    cam_from_map = geometry.inverse(final.relative_pose(pose))
    in_camera = means @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    ahead = np.flatnonzero(in_camera[:, 2] > 0)
    pixels = camera.project(in_camera[ahead], cameras.intrinsics[k])
    inside = ((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5])).all(axis=1)
    ahead, pixels = ahead[inside], pixels[inside]
    column, row = np.round(pixels).astype(int).T
    shown = in_camera[ahead, 2] <= (1.0 + BEHIND) * surface[row, column]
    return ahead[shown], pixels[shown]


def _is_ours(model: Path) -> bool:
    """Whether an earlier export lies there; False: nothing does. Raises ValueError for another program's model, of
    which readers take cameras.bin before a cameras.txt of ours."""
    files = sorted(path for path in model.glob("*") if path.suffix in (".bin", ".txt"))
    others = [path.name for path in files if _first_line(path) != HEADS.get(path.name)]
    if others:
        raise ValueError(
            f"{model} has a model that is no export of a map ({', '.join(others)}): give another folder, or move it"
        )
    return bool(files)


def _first_line(path: Path) -> str:
    with path.open("rb") as file:
        return file.readline(200).decode(errors="replace").rstrip()


def _copy(images: Path, target: Path, cameras: Cameras, *, replacing: bool) -> None:
    """replacing: images that are there may be."""
    found = {}
    for index, (height, width) in zip(cameras.keyframes.tolist(), cameras.sizes.tolist()):
        found[index] = images / image_name(index)
        try:
            check_size(found[index], (height, width))
        except FileNotFoundError:
            raise ValueError(f"{found[index]} is missing: run with mapper.save_images=true") from None
        there = target / found[index].name
        if not replacing and there.exists() and not filecmp.cmp(found[index], there, shallow=False):
            raise ValueError(f"{target} has another {found[index].name}: give another folder")
    target.mkdir(parents=True, exist_ok=True)
    for path in found.values():
        with atomic_file.replacing(target / path.name, sync=False) as aside:  # what is cut off can be done again
            shutil.copyfile(path, aside)


def _write(path: Path, lines: list[str]) -> None:
    atomic_file.replace_text(path, "\n".join(lines) + "\n")
