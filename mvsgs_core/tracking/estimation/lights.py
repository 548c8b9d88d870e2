"""The lights of images by number: solved for together, or one from its edges, and what color affines they make.

A wrong match may ask for any exposure: one that no camera has is none, as no reader takes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from mvsgs_core.photometry import is_exposure, is_vignetting
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.gray_levels import TERMS, backward
from mvsgs_core.tracking.estimation.photometry import PhotometricCalibration, PhotometricEdges, solve_photometry
from mvsgs_core.tracking.estimation.response import vignetting_polynomial

NO_LIGHT = "exposures or a vignetting that no camera has were found, and left out"


class ImageLights:
    """What is known of the light of images, and of the camera's vignetting."""

    def __init__(self, stats: Stats) -> None:
        self.stats = stats
        self.photometry = PhotometricCalibration.steady(0)
        self._lights: dict[int, np.ndarray] = {}  # (5,) by image, see `PhotometricCalibration.lights`
        self._refused: set[int | None] = set()  # images whose exposure no camera has; None: the vignetting

    @property
    def vignetting(self) -> np.ndarray | None:
        """(3,) float32, see `msgs`; None: there is none, or none that a lens has."""
        if not np.any(self.photometry.vignetting):
            return None
        found = vignetting_polynomial(self.photometry.vignetting, self.photometry.vignetting_response)
        found = found.astype(np.float32)
        if not is_vignetting(found):
            self._refuse(None)
            return None
        return found

    @property
    def varies(self) -> bool:
        return self.photometry.varies

    def exposure(self, index: int) -> np.ndarray | None:
        """(3, 4) float32 color affine of an image; None where exposures do not vary, nothing tells this one's, or it
        is one of no camera."""
        if not self.photometry.varies or index not in self._lights:
            return None
        return self._affine(index, self._lights[index])

    def _affine(self, index: int, light: np.ndarray) -> np.ndarray | None:
        """(3, 4) float32 of an image's light (5,); None for one that no camera has."""
        affine = self.photometry.affine(light)
        if not is_exposure(affine):
            self._refuse(index)
            return None
        return affine

    def _refuse(self, whose: int | None) -> None:
        """Counts it once, however often it is asked for."""
        if whose not in self._refused:
            self._refused.add(whose)
            self.stats.refuse("exposures", 1, NO_LIGHT)

    def _solved(
        self, images: Sequence[int], edges: PhotometricEdges, exposures: Iterable[float]
    ) -> dict[int, np.ndarray] | None:
        """Lights (5,) of K images, with `photometry` anew; None, with a warning, where there is no solution.

        edges: by the images' places. exposures: of each, see `msgs.Frame`; 0: not known.
        """
        given = np.fromiter(exposures, np.float64)
        known = np.where(given > 0.0, np.log(np.maximum(given, 1e-300)), np.nan)
        try:
            found = solve_photometry(edges, len(images), known)
        except (np.linalg.LinAlgError, ValueError) as error:
            self.stats.warn(f"exposures could not be solved for: {error}")
            return None
        if found.warning:
            self.stats.warn(found.warning)
        self.photometry = found
        return dict(zip(images, found.lights))

    def _attach(self, index: int, moments: Iterable[tuple[tuple[int, int], np.ndarray | None]]) -> None:
        """The light of one more image, from those whose edges with it have moments; other pairs' do not count."""
        found: list[tuple[float, np.ndarray]] = []
        for (a, b), between in moments:
            other = b if a == index else a
            if between is not None and index in (a, b) and other in self._lights:
                there = between if b == index else backward(between)
                information = 1.0 / (self.photometry.edge_sigma[0] ** 2 + 1.0 / there[:, 0, 0].mean())
                found.append((float(information), self._lights[other] + self.photometry.step(there)))
        if found:
            weights, lights = zip(*found)
            self._lights[index] = np.asarray(np.average(lights, axis=0, weights=weights))


def edges_between(images: Sequence[int], moments: Mapping[tuple[int, int], np.ndarray]) -> PhotometricEdges:
    """Of pairs of images with moments (3, 9, 9), by their places in `images`; pairs with others are left out."""
    number = {index: n for n, index in enumerate(images)}
    inner = {pair: found for pair, found in moments.items() if pair[0] in number and pair[1] in number}
    return PhotometricEdges(
        np.array([number[a] for a, _ in inner], np.int64),
        np.array([number[b] for _, b in inner], np.int64),
        np.array(list(inner.values())).reshape(-1, 3, TERMS, TERMS),
    )


__all__ = ["NO_LIGHT", "ImageLights", "edges_between"]
