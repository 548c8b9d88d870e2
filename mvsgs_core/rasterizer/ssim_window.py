"""The window of SSIM and its two constants, as every back end of it has them."""

from __future__ import annotations

RADIUS = 5  # pixels
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
