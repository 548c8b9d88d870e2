"""Places on the Earth: latitude, longitude (degrees) and altitude (m) of the ellipsoid WGS84, and metres around one.

Altitudes above sea level do as well as those above the ellipsoid: near one place they differ by a constant.
"""

from __future__ import annotations

import numpy as np

AXIS = 6378137.0  # m, from the center to the equator
FLATTENING = 1.0 / 298.257223563


def is_place(place: np.ndarray) -> bool:
    """Whether (latitude, longitude, altitude) can be one. (0, 0) is what receivers write that know none."""
    latitude, longitude, altitude = place
    possible = np.isfinite(place).all() and abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and abs(altitude) < 1e5
    return bool(possible and (latitude != 0.0 or longitude != 0.0))


def earth_centered(places: np.ndarray) -> np.ndarray:
    """(N, 3) metres from the Earth's center, x to (0, 0), z to the north pole, of places (N, 3)."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    squared = FLATTENING * (2.0 - FLATTENING)  # of the eccentricity
    across = AXIS / np.sqrt(1.0 - squared * np.sin(latitude) ** 2)
    ring = (across + places[:, 2]) * np.cos(latitude)
    height = (across * (1.0 - squared) + places[:, 2]) * np.sin(latitude)
    return np.stack([ring * np.cos(longitude), ring * np.sin(longitude), height], axis=1)


def east_north_up(places: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(N, 3) metres to the east, to the north and up of `origin` (3,), of places (N, 3)."""
    latitude, longitude = np.radians(origin[:2])
    (sin_n, cos_n), (sin_e, cos_e) = (np.sin(latitude), np.cos(latitude)), (np.sin(longitude), np.cos(longitude))
    axes = np.array(
        [
            [-sin_e, cos_e, 0.0],
            [-sin_n * cos_e, -sin_n * sin_e, cos_n],
            [cos_n * cos_e, cos_n * sin_e, sin_n],
        ]
    )
    return np.asarray((earth_centered(places) - earth_centered(origin[None])) @ axes.T)


def middle(places: np.ndarray) -> np.ndarray:
    """(3,) the median of places (N, 3), which a few false ones do not move; also across the 180th meridian."""
    turned = (places[:, 1] - places[0, 1] + 180.0) % 360.0 - 180.0
    longitude = (places[0, 1] + np.median(turned) + 180.0) % 360.0 - 180.0
    return np.array([np.median(places[:, 0]), longitude, np.median(places[:, 2])])


__all__ = ["earth_centered", "east_north_up", "is_place", "middle"]
