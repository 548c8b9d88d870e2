"""Confidence of a stereo depth as a calibrated probability that it is an inlier (within 5 % of the truth)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

# Logistic regression on `Evidence.features`, by `python -m bench.depth.calibration` without the town, all pixels alike.
# As it fits them now they are better on the town and worse on real video, by .02 and .03 of calibration error.
WEIGHTS = np.array([-0.949, 0.995, 0.339, 1.583, 0.681, -0.496, -0.08, 1.558, -1.006, 2.387, 0.919])
WITHOUT_GAP = np.array([-0.728, 1.001, 0.186, 2.07, 0.488, -0.178, 0.002, 2.586, -1.685, 0.0, 0.604])

BLACK = 128.0 + 10.0  # gray levels: views have 128 taken out; ten more keep the logarithm of black tame


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pixel's depth, each (H, W) float32."""

    correlation: np.ndarray  # ZNCC at the solution, mean of the two best views, 0 to 1
    support: np.ndarray  # part of the views that correlate above 0.6
    probability: np.ndarray  # of the last stage's softmax
    first_probability: np.ndarray  # of the first stage's
    relative_pixel: np.ndarray  # relative change of depth that moves the point by one pixel
    texture: np.ndarray  # gray levels: local contrast of the reference
    margin: np.ndarray  # of the last stage: how much worse other hypotheses are
    bend: np.ndarray  # relative change of inverse depth to the median around: high at jumps and where depth is noise
    gap: np.ndarray | None  # how much worse other surfaces around the pixel are; None: they were not looked at
    brightness: np.ndarray  # log of the gray level over the image's median: the dark is noise, and gaps between things

    @staticmethod
    def of(
        correlation: np.ndarray,
        probability: np.ndarray,
        margin: np.ndarray,
        first_probability: np.ndarray,
        relative_pixel: np.ndarray,
        gray: np.ndarray,
        inverse_depth: np.ndarray,
        gap: np.ndarray | None,
    ) -> Evidence:
        """From ZNCC of each view (N, H, W), -2 where not seen, and maps (H, W)."""
        ordered = np.sort(np.clip(correlation, 0.0, 1.0), axis=0)[::-1]
        best = ordered[: min(2, len(ordered))].mean(axis=0)
        mean = cv2.blur(gray, (5, 5))
        variance = np.maximum(cv2.blur(gray * gray, (5, 5)) - mean * mean, 0.0)
        return Evidence(
            correlation=best,
            support=np.asarray(np.mean(correlation > 0.6, axis=0, dtype=np.float32)),
            probability=probability,
            first_probability=first_probability,
            relative_pixel=np.asarray(relative_pixel, dtype=np.float32),
            texture=np.sqrt(variance),
            margin=margin,
            bend=np.abs(cv2.medianBlur(inverse_depth, 5) / np.maximum(inverse_depth, 1e-9) - 1.0),
            gap=gap,
            brightness=np.log((gray + BLACK) / (np.median(gray) + BLACK)).astype(np.float32),
        )

    def features(self) -> np.ndarray:
        """(F, H, W) float32, the first all ones."""
        return np.stack(
            [
                np.ones_like(self.correlation),
                self.correlation,
                self.support,
                self.probability,
                self.first_probability,
                np.log(np.clip(self.relative_pixel, 1e-4, 1.0) / 0.01),
                np.log(1.0 + self.texture),
                np.clip(self.margin, 0.0, 0.5),
                np.clip(cv2.blur(self.bend, (5, 5)) / 0.02, 0.0, 2.0),
                np.zeros_like(self.margin) if self.gap is None else np.sqrt(np.clip(self.gap, 0.0, 1.0)),
                self.brightness,
            ]
        ).astype(np.float32)


def probability_of_inlier(evidence: Evidence) -> np.ndarray:
    """(H, W) float32 in [0, 1]."""
    weights = WITHOUT_GAP if evidence.gap is None else WEIGHTS
    logit = np.tensordot(weights.astype(np.float32), evidence.features(), axes=1)
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), dtype=np.float32)
