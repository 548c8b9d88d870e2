"""A map at rest: rendered from any pose, exported to any format, read from the folder that a run or a program left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core import camera
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras, read_cameras, read_source_camera, write_cameras
from mvsgs_core.export.colmap import write_colmap
from mvsgs_core.export.command_line import map_file, sound_map
from mvsgs_core.export.image_sizes import check_sizes
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.mesh import write_mesh
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.export.splat import WRITERS
from mvsgs_core.export.transforms import write_transforms
from mvsgs_core.geometry import is_rigid
from mvsgs_core.rasterizer.interface import as_bytes

CAMERAS = "cameras.json"
MESHES = (".glb", ".obj", ".stl", ".off")


@dataclass(frozen=True)
class View:
    """What the map shows from a pose."""

    image: np.ndarray  # (H, W, 3) uint8 RGB, in the colors of the mean camera
    depth: np.ndarray  # (H, W) float32 z in the map's unit, 0 where nothing is seen
    opacity: np.ndarray  # (H, W) float32, 0 to 1: where it is small the map has nothing


@dataclass(frozen=True)
class GaussianMap:
    """Splats and, where they are known, the keyframes that they were seen from. It never changes."""

    snapshot: Snapshot
    cameras: Cameras | None  # None: a map.ply without cameras.json
    source: SourceCamera | None = None  # the camera that took the stream; None: not known
    file: Path | None = None  # that it was loaded from; None: none
    sources: tuple[Path, ...] = ()  # files that it comes from: `export` replaces none of them

    @classmethod
    def load(cls, path: str | Path, *, drop_unsound: bool = False, antialiased: bool | None = None) -> GaussianMap:
        """The map.ply, or the one in a folder, with its cameras.json.

        drop_unsound: leave out splats with NaN or Inf. antialiased: how it was trained, for the files of programs that
        leave no comment of it; None: as the file says. Raises OSError, ValueError for damaged files.
        """
        file = map_file(str(path))
        snapshot, _ = sound_map(file, drop_unsound, antialiased, "drop_unsound=True")
        beside = file.with_name(CAMERAS)
        if not beside.is_file():
            return cls(snapshot, None, file=file, sources=(file,))
        cameras = read_cameras(beside)
        camera = read_source_camera(beside)
        return cls(snapshot, cameras if len(cameras) else None, camera, file, (file, beside))

    def __len__(self) -> int:
        """Number of splats."""
        return len(self.snapshot.splats)

    def render(
        self, world_from_cam: np.ndarray, intrinsics: Sequence[float] | np.ndarray | None = None,
        size: tuple[int, int] | None = None,
    ) -> View:  # fmt: skip
        """What a camera would see: pose (4, 4), x right, y down, z forward.

        intrinsics: (fx, fy, cx, cy) in pixels at `size` = (height, width). What is not given is the newest keyframe's.
        Raises ValueError for a pose or a camera that is none.
        """
        pose = np.asarray(world_from_cam, dtype=np.float64)
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise ValueError("world_from_cam must be (4, 4): a rotation and a position, all finite")
        lens, size = self._camera(intrinsics, size)
        render = self.snapshot.render(pose, lens, size, near=near_plane(self.snapshot, pose))
        depth, opacity = render.depth.cpu().numpy(), render.opacity.cpu().numpy()
        return View(as_bytes(render.color), depth, opacity)

    def export(
        self, path: str | Path, *, voxel: float = 0.01, images: str | Path | None = None, observations: bool = False,
        fold: bool = False,
    ) -> Path:  # fmt: skip
        """Writes what the name asks for: .ply, .splat or .spz, a mesh (.glb, .obj, .stl, .off), cameras.json,
        transforms.json, or, without a suffix, the folder of a COLMAP model.

        voxel: edge of the mesh's grid in median depths. images: folder of the keyframes' images, for a model or
        transforms, which are without keyframes whose image is not there; of transforms the default is that beside the
        map that was loaded, else beside the file. observations: a COLMAP model's points say which images show them.
        fold: of a .ply the splats' shapes go into their scales, for viewers that know only Gaussians (mapper=paper).
        Raises ValueError for another name, for a file that the map was loaded from, or where keyframes are needed and
        not known; OSError.
        """
        out = Path(path).expanduser()
        if out.resolve() in [source.resolve() for source in self.sources]:
            raise ValueError(f"{out} is what this map was loaded from: give another file")
        if out.suffix == ".ply":
            write_ply(out, self.snapshot, fold=fold)
        elif out.suffix in WRITERS:
            WRITERS[out.suffix](out, self.snapshot)
        elif out.suffix in MESHES:
            write_mesh(out, self.snapshot, self._keyframes(out), voxel)
        elif out.name == CAMERAS:
            write_cameras(out, self._keyframes(out), self.source)
        elif out.suffix == ".json":
            beside = (self.file or out).with_name(keyframe_images.FOLDER)
            folder, keyframes = beside if images is None else Path(images), self._keyframes(out)
            check_sizes(folder, keyframes)
            write_transforms(out, keyframes, folder)
        elif not out.suffix:
            given = None if images is None else Path(images)
            write_colmap(out, self.snapshot, self._keyframes(out), given, observations)
        else:
            there = ", ".join((".ply", *WRITERS, *MESHES, ".json"))
            raise ValueError(f"{out}: no format {out.suffix!r}; there are: {there}, a folder")
        return out

    def _keyframes(self, out: Path) -> Cameras:
        if self.cameras is None:
            raise ValueError(f"{out} is made from the keyframes' cameras, and there is no cameras.json beside the map")
        return self.cameras

    def _camera(
        self, intrinsics: Sequence[float] | np.ndarray | None, size: tuple[int, int] | None
    ) -> tuple[np.ndarray, tuple[int, int]]:
        if intrinsics is not None and size is None:
            raise ValueError("intrinsics are in pixels of an image: give its size (height, width), too")
        if intrinsics is None:
            if self.cameras is None:
                raise ValueError("there is no cameras.json beside the map: give intrinsics and size")
            known = self.cameras.sizes[-1].tolist()
            size = size or (known[0], known[1])
            intrinsics = camera.scale_intrinsics(self.cameras.intrinsics[-1], (known[0], known[1]), size)
        assert size is not None
        lens = np.asarray(intrinsics, dtype=np.float64)
        if lens.shape != (4,):
            raise ValueError(f"intrinsics must be (fx, fy, cx, cy), got an array of shape {lens.shape}")
        camera.check_intrinsics(lens, size)
        return lens, (int(size[0]), int(size[1]))


__all__ = ["GaussianMap", "View"]
