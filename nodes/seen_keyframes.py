"""The keyframes that a viewer was shown, small, and what it shows of each: a render of then or of the refined map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from msgs import SplatMap
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.preview import known_depth
from mvsgs_core.rasterizer.interface import as_bytes
from nodes.keyframe_pictures import difference, thumbnail
from nodes.splat_map import snapshot_of

_GOOD, _BAD = 0.02, 0.1  # mean errors at the ends of the colors, of the range of brightness
Shown = tuple[np.ndarray, np.ndarray, np.ndarray | None]  # photograph, render, depth


@dataclass(frozen=True)
class SeenKeyframe:
    """One of them. Lengths are the map's, relative to its origin."""

    index: int
    world_from_cam: np.ndarray  # (4, 4)
    intrinsics: np.ndarray  # (4,) at `size`
    size: tuple[int, int]  # height, width of the photograph
    photograph: bytes  # JPEG, small
    render: bytes
    depth: np.ndarray | None  # (h, w) float32, see Preview
    error: float  # of the render, mean over the picture, 0 to 1
    coverage: float | None  # part of the picture that the map covers

    @staticmethod
    def of(
        index: int, world_from_cam: np.ndarray, intrinsics: np.ndarray, image: np.ndarray, render: np.ndarray,
        depth: np.ndarray | None,
    ) -> SeenKeyframe:  # fmt: skip
        photograph, rendered = thumbnail(image), thumbnail(render)
        return SeenKeyframe(
            index=index, world_from_cam=world_from_cam.copy(), intrinsics=intrinsics.copy(),
            size=(image.shape[0], image.shape[1]), photograph=_packed(photograph), render=_packed(rendered),
            depth=None if depth is None else depth.astype(np.float32),
            error=float(difference(rendered, photograph).mean()),
            coverage=None if depth is None else float((depth > 0).mean()),
        )  # fmt: skip


class SeenKeyframes:
    """In the order of the stream."""

    def __init__(self) -> None:
        self._seen: dict[int, SeenKeyframe] = {}
        self._newest: int | None = None
        self.splats: dict[int, int] = {}  # that came from each keyframe of the map
        self.final: Snapshot | None = None  # the refined map

    def __len__(self) -> int:
        return len(self._seen)

    def add(self, keyframe: SeenKeyframe) -> None:
        self._seen[keyframe.index] = keyframe
        self._newest = keyframe.index
        self._seen = dict(sorted(self._seen.items()))

    def move(self, index: int, world_from_cam: np.ndarray) -> None:
        if index in self._seen:
            self._seen[index] = replace(self._seen[index], world_from_cam=world_from_cam.copy())

    def remove(self, index: int) -> None:
        self._seen.pop(index, None)

    def at(self, place: int | None) -> SeenKeyframe | None:
        """That at a place of the order, from 0; None: the newest. None where there is none."""
        if not self._seen:
            return None
        if place is None:
            return self._seen.get(-1 if self._newest is None else self._newest, list(self._seen.values())[-1])
        return list(self._seen.values())[min(max(place, 0), len(self._seen) - 1)]

    def finish(self, message: SplatMap) -> Snapshot:
        """The refined map, from which keyframes are rendered from now on."""
        self.final = snapshot_of(message)
        anchors, counts = np.unique(self.final.anchors, return_counts=True)
        self.splats = dict(zip(anchors.tolist(), counts.tolist()))
        return self.final

    def shown(self, keyframe: SeenKeyframe) -> Shown:
        """Photograph and render (H, W, 3) uint8 and depth (h, w), small: of the refined map, once that is there."""
        photograph = _unpacked(keyframe.photograph)
        place = None if self.final is None else np.flatnonzero(self.final.keyframes == keyframe.index)
        if self.final is None or place is None or not len(place):
            return photograph, _unpacked(keyframe.render), keyframe.depth
        k, size = int(place[0]), (photograph.shape[0], photograph.shape[1])
        camera = Cameras(
            keyframes=np.array([keyframe.index]), timestamps=np.zeros(1),
            world_from_cam=self.final.world_from_cam[k : k + 1],
            intrinsics=scale_intrinsics(keyframe.intrinsics, keyframe.size, size)[None], sizes=np.array([size]),
            exposures=self.final.exposures[k : k + 1], vignetting=self.final.vignetting,
        )  # fmt: skip
        color, render = rendered_keyframe(self.final, camera, 0)
        return photograph, as_bytes(color), known_depth(render).numpy()

    def caption(
        self, keyframe: SeenKeyframe, photograph: np.ndarray, render: np.ndarray, depth: np.ndarray | None
    ) -> str:
        """In words what is shown of it."""
        parts = [f"keyframe **{keyframe.index}**, {keyframe.size[1]}x{keyframe.size[0]}"]
        if keyframe.index in self.splats:
            parts.append(f"{self.splats[keyframe.index]} splats came from it")
        if depth is not None and (depth > 0).any():
            near, far = np.percentile(depth[depth > 0], (5, 95))
            parts.append(f"depth {near:.3g} to {far:.3g}, {100 * (depth > 0).mean():.0f} % covered")
        parts.append(f"mean error {100 * difference(render, photograph).mean():.1f} %")
        return "; ".join(parts)

    def goodness(self, figure: str) -> dict[int, float]:
        """0, bad, to 1, good, by keyframe: of its "coverage" or "error", when it was last seen."""
        if figure == "coverage":
            return {index: seen.coverage for index, seen in self._seen.items() if seen.coverage is not None}
        return {index: goodness(seen.error) for index, seen in self._seen.items()}


def goodness(error: float) -> float:
    """0, bad, to 1, good, of the mean error of a render."""
    return (_BAD - error) / (_BAD - _GOOD)


def _packed(picture: np.ndarray) -> bytes:
    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be packed")
    return data.tobytes()


def _unpacked(data: bytes) -> np.ndarray:
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return np.ascontiguousarray(found[..., ::-1])


__all__ = ["SeenKeyframe", "SeenKeyframes", "goodness"]
