"""A triangle mesh of the map: rendered depth fused into a truncated signed distance field (open3d)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.glb import write_glb
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.open3d_loader import open3d


def write_mesh(
    path: Path, final: Snapshot, cameras: Cameras, voxel: float = 0.01, min_opacity: float = 0.5
) -> tuple[int, int]:
    """Renders depth from the cameras, fuses it and writes a mesh with colors: .glb, or what open3d writes (.ply, .obj).

    voxel: edge in median depths. Pixels of an opacity below `min_opacity` say nothing. Positions are world coordinates,
    in the axes of map.ply except for .glb, whose axes are defined. Returns the numbers of vertices and triangles.
    Raises ValueError where no camera sees the map or the depth makes no surface.
    """
    o3d = open3d()
    views = []
    for pose, intrinsics, size in zip(cameras.world_from_cam, cameras.intrinsics, cameras.sizes.tolist()):
        render = final.render(pose, intrinsics, (size[0], size[1]), near=near_plane(final, pose))
        depth = torch.where(render.opacity >= min_opacity, render.depth, 0.0)
        views.append((final.relative_pose(pose), intrinsics, depth.numpy(), render.color.clamp(0.0, 1.0).numpy()))
    seen = [depth[depth > 0] for _, _, depth, _ in views if (depth > 0).any()]
    if not seen:
        raise ValueError("no camera sees the map: nothing to fuse; check that the poses are those of this map")
    median, farthest = float(np.median(np.concatenate(seen))), float(np.max([values.max() for values in seen]))
    edge = voxel * median
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=edge,
        block_resolution=16,
        block_count=10000,
    )
    truncation = 6.0  # voxels, of the distance field
    for local, intrinsics, seen_depth, color in views:
        matrix = o3d.core.Tensor(camera.matrix(intrinsics))
        extrinsic = o3d.core.Tensor(np.linalg.inv(local))
        depth_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(seen_depth)))
        color_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(color)))
        blocks = grid.compute_unique_block_coordinates(depth_image, matrix, extrinsic, 1.0, farthest, truncation)
        grid.integrate(blocks, depth_image, color_image, matrix, matrix, extrinsic, 1.0, farthest, truncation)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    if not len(mesh.triangles):
        raise ValueError("the depth makes no surface: try a larger --voxel")
    vertices, triangles, colors = map(np.asarray, (mesh.vertices, mesh.triangles, mesh.vertex_colors))
    if path.suffix == ".glb":
        write_glb(path, vertices, triangles, colors, final.origin)
    elif path.suffix == ".ply":
        write_mesh_ply(path, vertices + final.origin, triangles, colors, 0.01 * edge)
    else:
        mesh.translate(final.origin)
        if path.suffix == ".stl":
            mesh.compute_triangle_normals()  # the format has them, and open3d writes none without
        if not o3d.io.write_triangle_mesh(str(path), mesh):
            raise OSError(f"open3d could not write {path}")
    return len(mesh.vertices), len(mesh.triangles)


def write_mesh_ply(
    path: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray, tolerance: float
) -> None:
    """Vertices (V, 3), triangles (T, 3) of their indices, colors (V, 3) in [0, 1]; binary little endian.

    Positions are float32, as three.js draws no others, unless that is off by more than `tolerance`: then float64.
    """
    short = np.abs(vertices.astype(np.float32) - vertices).max(initial=0.0) <= tolerance
    kind, name = ("<f4", "float") if short else ("<f8", "double")
    points = np.zeros(len(vertices), dtype=[("position", kind, 3), ("color", "u1", 3)])
    points["position"], points["color"] = vertices, np.clip(np.round(255.0 * colors), 0, 255)
    faces = np.zeros(len(triangles), dtype=[("corners", "u1"), ("vertex", "<i4", 3)])
    faces["corners"], faces["vertex"] = 3, triangles
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(points)}",
        *(f"property {name} {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue")),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode() + points.tobytes() + faces.tobytes())
