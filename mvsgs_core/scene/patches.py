"""Surfaces as grids of points over (v, u), each with a texture: boxes, cylinders, lathes, spheres, height fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

Vector = Sequence[float] | np.ndarray  # (3,) scene units
Texture = np.ndarray  # (h, w, 3) uint8 sRGB; row 0 is v = 0
# A material paints a texture for a surface of (height, width) in scene units (v, u).
Material = Callable[[float, float], Texture]


@dataclass(frozen=True)
class Patch:
    """A grid surface. Seen from its front, u (columns) runs right and v (rows) down, as in an image."""

    points: np.ndarray  # (m + 1, n + 1, 3) float64, scene units
    texture: Texture
    gloss: float = 0.0  # strength of the highlight where the renderer's gloss switch is on
    emission: float | None = None  # constant light instead of the baked one: windows, lamp shades
    two_sided: bool = False  # thin: lit from both sides


def extent(points: np.ndarray) -> tuple[float, float]:
    """(height, width): mean length of the columns (along v) and rows (along u) of a grid."""
    along_v = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum(axis=0).mean()
    along_u = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1).mean()
    return float(along_v), float(along_u)


def surface(points: np.ndarray, material: Material, *, gloss: float = 0.0, two_sided: bool = False) -> Patch:
    """A patch painted by `material` at its own size."""
    return Patch(np.asarray(points, dtype=np.float64), material(*extent(points)), gloss=gloss, two_sided=two_sided)


def quad(corner: Vector, along_u: Vector, along_v: Vector) -> np.ndarray:
    """(2, 2, 3) points of a parallelogram."""
    c, u, v = (np.asarray(x, dtype=np.float64) for x in (corner, along_u, along_v))
    return np.stack([np.stack([c, c + u]), np.stack([c + v, c + u + v])])


def box_faces(low: Vector, high: Vector) -> dict[str, np.ndarray]:
    """Outward quads of an axis-aligned box by side; v runs down on the sides, "front" is the -y side."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    return {
        "front": quad((x0, y0, z1), (dx, 0, 0), (0, 0, -dz)),
        "back": quad((x1, y1, z1), (-dx, 0, 0), (0, 0, -dz)),
        "left": quad((x0, y1, z1), (0, -dy, 0), (0, 0, -dz)),
        "right": quad((x1, y0, z1), (0, dy, 0), (0, 0, -dz)),
        "top": quad((x0, y1, z1), (dx, 0, 0), (0, -dy, 0)),
        "bottom": quad((x0, y0, z0), (dx, 0, 0), (0, dy, 0)),
    }


def box(
    low: Vector,
    high: Vector,
    material: Material,
    *,
    skip: Sequence[str] = ("bottom",),
    gloss: float = 0.0,
) -> list[Patch]:
    """A box of one material; `skip` leaves out sides that nothing sees."""
    return [surface(p, material, gloss=gloss) for side, p in box_faces(low, high).items() if side not in skip]


def lathe(
    center: Vector,
    profile: Sequence[tuple[float, float]],
    material: Material,
    *,
    segments: int = 20,
    gloss: float = 0.0,
    two_sided: bool = False,
) -> Patch:
    """Surface of revolution about a vertical axis; profile of (radius, height), from the top down to face outward."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    radius, height = np.asarray(profile, dtype=np.float64).T
    points = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (len(radius), segments + 1)),
        ],
        axis=-1,
    ) + np.asarray(center, dtype=np.float64)
    return surface(points, material, gloss=gloss, two_sided=two_sided)


def cylinder(
    center: Vector, radius: float, height: float, material: Material, *, segments: int = 16, gloss: float = 0.0
) -> list[Patch]:
    """A standing cylinder with its lid; `center` is the middle of the base."""
    side = lathe(center, [(radius, height), (radius, 0.0)], material, segments=segments, gloss=gloss)
    lid = lathe(center, [(1e-4, height), (radius, height)], material, segments=segments, gloss=gloss)
    return [side, lid]


def blob(
    center: Vector,
    radii: Vector,
    material: Material,
    *,
    square: float = 1.0,
    bumps: float = 0.0,
    rng: np.random.Generator | None = None,
    rows: int = 10,
    columns: int = 16,
) -> Patch:
    """A superellipsoid: `square` 1 is an ellipsoid, smaller ones are pillows; `bumps` shifts points, relative."""
    v = np.linspace(0.02, np.pi - 0.02, rows + 1)[:, None]
    u = np.linspace(0.0, 2.0 * np.pi, columns + 1)[None, :]
    shape = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v) + 0.0 * u], axis=-1)
    shape = np.sign(shape) * np.abs(shape) ** square
    if bumps > 0.0 and rng is not None:
        factor = 1.0 + bumps * rng.standard_normal((rows + 1, columns + 1))
        factor[:, -1] = factor[:, 0]
        shape *= factor[..., None]
    return surface(np.asarray(center) + shape * np.asarray(radii), material)


def transformed(patches: Sequence[Patch], yaw: float, shift: Vector) -> list[Patch]:
    """Patches turned about the vertical axis (radians) and then moved."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [replace(p, points=p.points @ turn.T + np.asarray(shift, dtype=np.float64)) for p in patches]


def sample(points: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Points (len(v), len(u), 3) at parameters in [0, 1], on the two triangles that `triangles` makes of each cell."""
    m, n = points.shape[0] - 1, points.shape[1] - 1
    i = np.minimum((v * m).astype(int), m - 1)
    j = np.minimum((u * n).astype(int), n - 1)
    y, x = (v * m - i)[:, None, None], (u * n - j)[None, :, None]
    a, b = points[i][:, j], points[i][:, j + 1]
    c, d = points[i + 1][:, j], points[i + 1][:, j + 1]
    return np.where(x + y <= 1.0, a + x * (b - a) + y * (c - a), d + (1.0 - x) * (c - d) + (1.0 - y) * (b - d))


def normals(points: np.ndarray) -> np.ndarray:
    """Unit normals (m + 1, n + 1, 3) of a grid surface, to its front."""
    du, dv = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(dv, du)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12))


def triangles(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (T, 3, 3) and texture coordinates (T, 3, 2) as (u, v) in [0, 1] of a grid surface, two a cell."""
    m, n = points.shape[0] - 1, points.shape[1] - 1
    v, u = np.meshgrid(np.arange(m + 1) / m, np.arange(n + 1) / n, indexing="ij")
    vertex = np.concatenate([points, u[..., None], v[..., None]], axis=-1)
    a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    cells = np.stack([np.stack([a, b, c], axis=2), np.stack([b, d, c], axis=2)], axis=2).reshape(-1, 3, 5)
    return cells[..., :3], cells[..., 3:]
