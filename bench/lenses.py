"""How much lenses bend: `python -m bench.lenses`, from published calibrations, as one k1 would have it.

Lenses are published with several coefficients that make up for each other within the picture. Here each is told by one,
with the focal length that goes with it best: what remains to be known of a lens whose focal length is looked for.
Phones, webcams, compact and depth cameras: what people film with. Lenses of machines bend more, by -0.2 and beyond, and
come with a calibration.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from bench.table import Row, main
from mvsgs_core.tracking.estimation.radial import COMMON

NORMAL = 1.4826  # standard deviation over the median of absolute values, of a normal distribution
GRID = 64  # points along each side of the picture


@dataclass(frozen=True)
class Published:
    name: str
    size: tuple[int, int]  # (height, width)
    focal: float  # pixels, mean of both axes
    coefficients: tuple[float, float, float]  # k1, k2, k3 of Brown's model

    def one(self) -> tuple[float, float]:
        """k1 alone, and the factor on the focal length that goes with it."""
        height, width = self.size
        y = (np.arange(GRID) / (GRID - 1) - 0.5)[:, None] * (height - 1) / self.focal
        x = (np.arange(GRID) / (GRID - 1) - 0.5) * (width - 1) / self.focal
        r2 = (x * x + y * y).ravel()
        k1, k2, k3 = self.coefficients
        r = np.sqrt(r2)
        seen = r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        factor, bend = np.linalg.lstsq(np.stack([r, r * r2], axis=1), seen)[0]
        return float(bend / factor), float(factor)


PUBLISHED = (
    Published("TUM RGB-D freiburg1, Kinect", (480, 640), 516.9, (0.262383, -0.953104, 1.163314)),
    Published("TUM RGB-D freiburg2, Kinect", (480, 640), 521.4, (0.231222, -0.784899, 0.917205)),
    Published("instant-ngp fox, iPhone", (1920, 1080), 1375.0, (0.0578421, -0.0805099, 0.0)),
    Published("mmamustafa/computer-vision, iPhone", (1632, 1224), 1355.7, (0.168208, -0.716556, 1.630555)),
    Published("South Building, compact camera", (2304, 3072), 2559.68, (-0.0205, 0.0, 0.0)),
    Published("davi1055/project, webcam", (480, 640), 578.5, (0.134462, -0.311908, 0.0)),
)


def measure(_: argparse.Namespace) -> list[Row]:
    found = [lens.one() for lens in PUBLISHED]
    rows = [Row(f"k1, {lens.name}", k1, "") for lens, (k1, _) in zip(PUBLISHED, found)]
    middle = float(np.median([abs(k1) for k1, _ in found]))
    rows.append(Row("half of them bend less than", middle, ""))
    rows.append(Row("standard deviation of a normal distribution of which half does", NORMAL * middle, ""))
    rows.append(Row("taken for it (radial.COMMON)", COMMON, ""))
    return rows


if __name__ == "__main__":
    main(measure, "How much lenses bend")
