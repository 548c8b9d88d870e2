"""How well a finished map shows the images it was made of, and what keeps it from it. No truth is needed for it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.image_metrics import psnr
from mvsgs_core.stats import Stats

MIN_PSNR = 25.0  # dB; a static map of sharp, steady images is above this
MAX_EXPOSURE_GAIN = 1.5  # dB that one gain and offset an image and channel may bring before exposure is to blame
MIN_STEADY_PSNR = 22.0  # dB that they must reach: a render of something else gains by them, too
MAX_NOISE = 6.0  # of 255; sharp and steady images without noise read 0.5 to 3.1, small and textured ones the most
Shown = tuple[np.ndarray, np.ndarray, np.ndarray | None]  # render, image (H, W, 3), pixels (H, W) that count; None: all
_SECOND_DERIVATIVE = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])


@dataclass(frozen=True)
class SelfCheck:
    """Medians over the pairs; `noise` of 255."""

    psnr: float  # dB
    steady_psnr: float  # dB, after the gain and offset an image and channel that fit best
    noise: float

    @property
    def noise_limit(self) -> float:
        """PSNR of a perfect map against these images, dB: what the noise alone leaves."""
        return float(20.0 * np.log10(255.0 / self.noise)) if self.noise > 0.0 else float("inf")

    @property
    def warning(self) -> str | None:
        """What to tell the user; None where the map shows its images, and the images are good."""
        if self.psnr >= MIN_PSNR:
            return self._noise_warning
        causes = []
        if self.steady_psnr > max(MIN_STEADY_PSNR, self.psnr + MAX_EXPOSURE_GAIN):
            causes.append(f"changes of exposure that nobody knows (without: {self.steady_psnr:.1f} dB)")
        if self.noise > MAX_NOISE:
            causes.append(f"noise of {self.noise:.0f} of 255")
        known = " and ".join(causes) or "motion, blur, wrong poses or too few iterations"
        return (
            f"the map renders its own keyframes at {self.psnr:.1f} dB only ({MIN_PSNR:g} expected): the images hold "
            f"what a static map cannot show, here {known}"
        )

    @property
    def _noise_warning(self) -> str | None:
        """Of a map that fits its noisy keyframes: it has learned some of their noise, and other views show that."""
        if self.noise <= MAX_NOISE:
            return None
        return (
            f"the images hold noise of {self.noise:.0f} of 255: even a perfect map would render them at "
            f"{self.noise_limit:.1f} dB only. Stereo keeps less depth, and the map learns some of the noise: more "
            "light, a longer exposure or smaller images (dataset.size) help"
        )


def check(pairs: Iterable[Shown]) -> SelfCheck | None:
    """Of renders and images, float in 0..1, one after the other; None without any of which a pixel counts."""
    found = [
        (psnr(render, image, mask), psnr(_fitted(render, image, mask), image, mask), noise_of(image, mask))
        for render, image, mask in pairs
        if mask is None or mask.any()
    ]
    return SelfCheck(*np.median(found, axis=0).tolist()) if found else None


def why_nothing(log: Stats, before: Mapping[str, float] | None = None) -> str:
    """Why a map has no splat: what was counted on the way. before: what had been when it was begun, of another map."""

    def counted(name: str) -> int:
        return int(log.counts.get(name, 0) - (before or {}).get(name, 0))

    views, refused = counted("views"), counted("refused_views")
    if not views and not refused:
        return "the mapper made no splat: no keyframe with depth came to it"
    if not views:
        return f"the mapper made no splat: all {refused} keyframes were refused ({log.warnings[0]})"
    blind = counted("views_without_depth")
    if blind == views:
        return f"the mapper made no splat: none of {views} keyframes had a pixel with depth after the filters"
    return (
        f"the mapper has no splat left: {views} keyframes, {views - blind} of them with depth, gave "
        f"{counted('inserted')} splats; all of them faded out"
    )


def noise_of(image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Standard deviation of an image's noise, of 255; mask: (H, W) bool, pixels that count, 0 where none is among such.

    The second derivative in both directions leaves noise and hardly any structure; the median of its size looks past
    the corners that remain (after Immerkaer, "Fast noise variance estimation", 1996).
    """
    residual = cv2.filter2D(image.astype(np.float32), cv2.CV_32F, _SECOND_DERIVATIVE)[1:-1, 1:-1]
    if mask is not None:
        residual = residual[cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0]
    if not residual.size:
        return 0.0
    return float(255.0 * np.median(np.abs(residual)) / (0.6745 * np.sqrt((_SECOND_DERIVATIVE**2).sum())))


def _fitted(render: np.ndarray, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """The render under the gain and offset of each channel that bring it closest to the image where pixels count."""
    counts = slice(None) if mask is None else mask
    fitted = np.empty_like(render)
    for channel in range(3):
        x, y = (values[..., channel][counts].ravel().astype(np.float64) for values in (render, image))
        spread = x.var()
        gain = float(((x - x.mean()) * (y - y.mean())).mean() / spread) if spread > 0.0 else 0.0
        fitted[..., channel] = gain * (render[..., channel] - x.mean()) + y.mean()
    return fitted
