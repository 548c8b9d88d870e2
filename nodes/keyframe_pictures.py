"""The pictures beside a map in a browser: a photograph, what the map shows from there, and how far they differ."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser

from mvsgs_core.camera import resize_image, scale_intrinsics
from mvsgs_core.evaluation.scoring import colorize, colorize_depth

WIDTH = 320  # pixels of the pictures beside the scene: enough to compare, quick to send
KINDS = {"photograph": True, "render": True, "depth": True, "error": False, "coverage": False}  # shown at first
_UNCOVERED = (255, 0, 160)
_ERROR = 4.0  # by which errors are brightened, as in a report


def thumbnail(image: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) as small as it is shown beside the scene."""
    step = max(1, image.shape[1] // WIDTH)
    return np.ascontiguousarray(image[::step, ::step])


def pictures(
    photograph: np.ndarray | None, render: np.ndarray | None, depth: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Those that can be made, by name: photograph and render (H, W, 3) uint8, depth (h, w), 0 where the map covers a
    pixel by less than half. Small, all of one size."""
    first = next((given for given in (render, photograph, depth) if given is not None), None)
    if first is None:
        return {}
    width = min(WIDTH, first.shape[1])
    size = (max(1, round(first.shape[0] * width / first.shape[1])), width)
    shown = {name: p for name, p in (("photograph", photograph), ("render", render)) if p is not None}
    shown = {name: resize_image(picture, size) for name, picture in shown.items()}
    if len(shown) == 2:
        shown["error"] = colorize(np.clip(_ERROR * difference(shown["render"], shown["photograph"]), 0.0, 1.0))
    if depth is not None:
        shown["depth"] = _of_size(colorize_depth(depth), size)
        behind = shown.get("photograph", shown.get("render", np.zeros((*size, 3), np.uint8)))
        uncovered = _of_size(depth <= 0, size)[..., None]
        shown["coverage"] = np.where(uncovered, np.array(_UNCOVERED, np.uint8), behind)
    return shown


def difference(render: np.ndarray, photograph: np.ndarray) -> np.ndarray:
    """(H, W) in 0..1, mean over the colors, of pictures (H, W, 3) uint8."""
    return np.asarray(np.abs(render.astype(np.float32) - photograph.astype(np.float32)).mean(axis=2) / 255.0)


def _of_size(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The nearest values of a map (h, w, ...) of the same field of view."""
    rows, columns = (
        ((np.arange(there) + 0.5) * have / there).astype(int) for there, have in zip(size, values.shape[:2])
    )
    return np.ascontiguousarray(values[rows][:, columns])


def depth_points(
    depth: np.ndarray, intrinsics: np.ndarray, image: np.ndarray, limit: int = 4000
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 in the camera's axes, at most about `limit`, of the known depths (h, w), and their colors
    (N, 3) uint8 in the image (H, W, 3), whose intrinsics (4,) are given."""
    size = (depth.shape[0], depth.shape[1])
    fx, fy, cx, cy = scale_intrinsics(intrinsics, (image.shape[0], image.shape[1]), size)
    step = max(1, int(np.ceil(np.sqrt(depth.size / limit))))
    grid = np.meshgrid(np.arange(0, size[0], step), np.arange(0, size[1], step), indexing="ij")
    rows, columns = (each.ravel() for each in grid)
    z = depth[rows, columns]
    known = np.isfinite(z) & (z > 0)
    rows, columns, z = rows[known], columns[known], z[known]
    points = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1).astype(np.float32)
    return points, _of_size(image, size)[rows, columns]


class KeyframePictures:
    """The pictures in the page, with a box for each kind."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._visible, self._shown = dict(KINDS), dict.fromkeys(KINDS, False)
        with gui.add_folder("pictures", expand_by_default=False):
            self.boxes = {name: gui.add_checkbox(name, visible) for name, visible in KINDS.items()}
        blank = np.zeros((2, 2, 3), np.uint8)
        self.handles = {name: gui.add_image(blank, label=name, format="jpeg", visible=False) for name in KINDS}
        for name, box in self.boxes.items():
            box.on_update(lambda event, name=name: self.set_visible(name, bool(event.target.value)))  # type: ignore[misc]

    def set_visible(self, name: str, visible: bool) -> None:
        self._visible[name] = visible
        self.handles[name].visible = visible and self._shown[name]

    def show(self, shown: Mapping[str, np.ndarray]) -> None:
        """Pictures (H, W, 3) uint8 by kind; those that are not given are not shown."""
        for name, handle in self.handles.items():
            self._shown[name] = name in shown
            if name in shown:
                handle.image = shown[name]
            handle.visible = self._visible[name] and self._shown[name]


__all__ = ["KINDS", "KeyframePictures", "depth_points", "difference", "pictures", "thumbnail"]
