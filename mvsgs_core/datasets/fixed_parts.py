"""What is fixed to the camera and not of the scene: bars beside a video, a logo, a date, a car's hood, a robot's arm.

An edge of the scene moves in the image as the camera does. One that stays where it is to half a pixel, from picture to
picture while the rest moves, is of something that moves with the camera, and so is what such edges cut off.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.camera import fit_size, resize_image

AREA = 320 * 240  # pixels of the reduced pictures that are compared, at most
DOUBT = 12  # pictures after which a stream without any such edge has nothing that is fixed
EVERY, WINDOW = 24, 48  # pictures after which they are looked for, again and again, in the newest so many
CHANGED = 8.0  # gray levels by which a pixel that shows something else differs
MOVED = 0.25  # of the pixels that change at all: so many differ between two pictures of a camera that moved
EDGE = 3.5  # gray levels a pixel: the least gradient of an edge
STAYS = 0.9  # of the pictures: those in which a fixed edge is there
TURNS = 0.02  # of a thing's gradients, the second moment along its edges over that across: a straight edge may slide
SMALLEST = 40  # pixels of one thing's edges
MOST = 0.5  # of all edges: if more stay, the camera does, and something else moves
DARK, NOISE = 40.0, 6.0  # gray levels of a bar: the most, and how much they differ
BLACK = 16.0  # gray levels of a rim, the most: what an undistorted picture has where the lens saw nothing
CONVEX = 0.97  # of the convex hull of what a rim leaves
ACROSS = 0.8  # of the width or the height, which that reaches across at least
REACH = 4  # pixels between edges of one thing
BESIDE, STILL = 12, 3.0  # pixels from a thing and the deviation in gray levels of what is still of it, without edges
MARGIN = 3  # pixels beside what is fixed that show some of it


class FixedParts:
    """Finds them in the pictures of one camera, as they come."""

    def __init__(self) -> None:
        self.mask: np.ndarray | None = None  # (H, W) bool, False where something is fixed; None: nothing is
        self.judged = False  # enough pictures came to know, or to think that nothing is fixed
        self._settled = False  # nothing is fixed: no more pictures are compared
        self._count = 0  # of the pictures that were
        # (h, w) float32 gray, each of a camera that moved since the one before
        self._pictures: deque[np.ndarray] = deque(maxlen=WINDOW)
        self._size = (0, 0)
        self._low = self._high = np.zeros((0, 0), np.float32)  # (h, w) a pixel's darkest and brightest, of all frames

    @property
    def share(self) -> float:
        """Of the image."""
        return 0.0 if self.mask is None else 1.0 - float(self.mask.mean())

    def add(self, image: np.ndarray) -> None:
        """The next frame, (H, W, 3) uint8. One of another size begins anew."""
        size = image.shape[0], image.shape[1]
        if self._settled and size == self._size:
            return
        gray = cv2.cvtColor(resize_image(image, fit_size(*size, AREA, 1)), cv2.COLOR_RGB2GRAY).astype(np.float32)
        if size != self._size:
            self.mask, self.judged, self._settled = None, False, False
            self._size, self._low, self._high = size, gray, gray
            self._pictures.clear()
            self._count = 0
        self._low, self._high = np.minimum(self._low, gray), np.maximum(self._high, gray)
        if self._pictures and not self._moved(gray):
            return
        self._pictures.append(gray)
        self._count += 1
        if self._count == DOUBT:
            self._settled = not fixed_in(Edges.of(self._pictures)).any()
        elif self._count % EVERY == 0:  # a robot may stand before a crowd at first, or lift its arm
            self._judge(Edges.of(self._pictures))
        self.judged |= self._settled or self._count >= EVERY

    def _judge(self, edges: Edges) -> None:
        if edges.share > MOST:  # the camera stood, and something else moved
            self._pictures.clear()
            self._count = 0
            self.judged = True
            return
        fixed = fixed_in(edges)
        self.mask = ~_enlarged(fixed, self._size) if fixed.any() and not fixed.all() else None
        self._settled = self.mask is None and self._count == WINDOW

    def _moved(self, gray: np.ndarray) -> bool:
        active = self._high - self._low > 2.0 * CHANGED
        return bool(active.any() and np.mean(np.abs(gray - self._pictures[-1])[active] > CHANGED) > MOVED)


@dataclass(frozen=True)
class Edges:
    """Which edges of some pictures (n, h, w) stay where they are."""

    pictures: np.ndarray  # float32
    stay: np.ndarray  # (h, w) bool
    direction: np.ndarray  # (h, w, 2) of their gradients, of length 1
    share: float  # of all edges

    @staticmethod
    def of(pictures: Collection[np.ndarray]) -> Edges:
        """Of pictures (h, w) float32."""
        stack = np.stack(list(pictures))
        gradients = np.stack([_gradient(picture) for picture in stack])
        usual = gradients.mean(axis=0)
        strength = np.hypot(usual[..., 0], usual[..., 1])
        direction = usual / np.maximum(strength, EDGE)[..., None]
        along = np.einsum("nhwc,hwc->nhw", gradients, direction)  # what is behind a text makes it stronger or weaker
        across = gradients[..., 0] * direction[..., 1] - gradients[..., 1] * direction[..., 0]
        least = 0.5 if len(stack) >= WINDOW else 0.8  # straight ahead, what is far stays for a while, and grows
        same = (along > least * strength) & (np.abs(across) < 0.2 * strength + 0.7)
        stay = (strength > EDGE) & (same.mean(axis=0) >= STAYS)
        edges = int(np.sum(np.hypot(gradients[..., 0], gradients[..., 1]).mean(axis=0) > EDGE))
        return Edges(stack, stay, direction, float(stay.sum() / max(1, edges)))


def fixed_in(edges: Edges) -> np.ndarray:
    """(h, w) bool: what is fixed to the camera that took the pictures."""
    changes = edges.pictures.std(axis=0)
    fixed = _things(edges)
    fixed |= _cut_off(fixed, changes)
    fixed |= (changes < STILL) & (cv2.dilate(fixed.astype(np.uint8), _disk(BESIDE)) > 0)
    fixed |= _bars(edges.pictures, fixed) | _rim(edges.pictures)
    return np.asarray(cv2.dilate(fixed.astype(np.uint8), _disk(MARGIN)) > 0)


def _things(edges: Edges) -> np.ndarray:
    """(h, w) bool: edges that stay, and what is between those of one thing."""
    joined = cv2.morphologyEx(edges.stay.astype(np.uint8), cv2.MORPH_CLOSE, _disk(REACH))
    count, labels = cv2.connectedComponents(joined, connectivity=8)
    normals, of = edges.direction[edges.stay], labels[edges.stay]  # (N, 2), (N,)
    pixels = np.bincount(of, minlength=count)
    xx, xy, yy = (
        np.bincount(of, normals[:, a] * normals[:, b], minlength=count) / np.maximum(pixels, 1)
        for a, b in ((0, 0), (0, 1), (1, 1))
    )
    spread = np.sqrt((xx - yy) ** 2 + 4.0 * xy**2)  # of the eigenvalues of their second moments, which sum to 1
    turns = (1.0 - spread) > TURNS * (1.0 + spread)
    kept = (pixels >= SMALLEST) & turns
    kept[0] = False
    return np.asarray(kept[labels])


def _cut_off(things: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """(h, w) bool: what things part from the largest piece, the scene, and changes less. changes: (h, w) deviations."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~things).astype(np.uint8), connectivity=4)
    if count <= 2:
        return np.zeros_like(things)
    scene = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    usual = np.median(changes[labels == scene])
    still = [n for n in range(1, count) if n != scene and np.median(changes[labels == n]) < 0.5 * usual]
    return np.asarray(np.isin(labels, still))


def _bars(stack: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """(h, w) bool: dark bars of one thickness at two opposite sides, with what is fixed in them."""
    low, high = stack.min(axis=0), stack.max(axis=0)
    dark = ((high < DARK) & (high - low < NOISE)) | fixed
    bars = np.zeros_like(dark)
    for lines, marked in ((dark, bars), (dark.T, bars.T)):
        whole = np.mean(lines, axis=1) > 0.995
        first, last = int(np.argmin(whole)), int(np.argmin(whole[::-1]))  # thickness of both
        if not whole.all() and min(first, last) >= 2 and abs(first - last) <= 2 + 0.1 * max(first, last):
            marked[:first] = marked[len(whole) - last :] = True
    return bars


def _rim(stack: np.ndarray) -> np.ndarray:
    """(h, w) bool: black that reaches two opposite sides and is bent, around a convex picture; it may have no edge that
    stays, where what is behind it is dark at times."""
    low, high = stack.min(axis=0), stack.max(axis=0)
    black = (high < BLACK) & (high - low < NOISE)
    _, labels = cv2.connectedComponents(np.pad(black, 1, constant_values=True).astype(np.uint8), connectivity=4)
    rim = (labels == labels[0, 0])[1:-1, 1:-1]
    opposite = (rim[0].any() and rim[-1].any()) or (rim[:, 0].any() and rim[:, -1].any())
    rows, columns = np.nonzero(~rim)
    # what is not black reaches across the picture: else it is a lamp in the dark
    if not opposite or not len(rows) or max(np.ptp(rows) / rim.shape[0], np.ptp(columns) / rim.shape[1]) < ACROSS:
        return np.zeros_like(rim)
    hull = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
    inside = cv2.fillConvexPoly(np.zeros(rim.shape, np.uint8), hull, 1)
    return rim if len(rows) >= CONVEX * inside.sum() else np.zeros_like(rim)


def _gradient(picture: np.ndarray) -> np.ndarray:
    """(h, w, 2) float32 in gray levels a pixel."""
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.7)
    return np.stack(
        [cv2.Sobel(smooth, cv2.CV_32F, *which, ksize=3, scale=1 / 8) for which in ((1, 0), (0, 1))], axis=-1
    )


def _disk(radius: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))


def _enlarged(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask (h, w) bool at (height, width)."""
    return cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0


__all__ = ["FixedParts"]
