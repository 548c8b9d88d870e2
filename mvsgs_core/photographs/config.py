"""What can be set of the tracker of photographs."""

from __future__ import annotations

from dataclasses import dataclass

from mvsgs_core.setting_ranges import at_least


@dataclass(frozen=True)
class PhotographsConfig:
    """Raises ValueError for numbers of which nothing can come."""

    features: int = 3000  # of a photograph, at most
    neighbors: int = 20  # photographs that each is matched with, the most alike; of 30 or fewer all are
    near: int = 6  # and, where GPS says so, with the nearest
    refine_lens: bool = True  # focal length and radial distortion, shared by all, are estimated from what is given
    because: str = ""  # why this tracker was taken where nobody chose it: said in the report
    area: int = 320 * 240  # pixels of the grid of 8x8 cells that the points are sent on, as of the other trackers

    def __post_init__(self) -> None:
        at_least(self, area=1)
        if self.features < 100:
            raise ValueError(f"tracker.features={self.features}: of fewer than 100 no photograph gets a pose")
        if self.near < 0:
            raise ValueError(f"tracker.near={self.near}: a number of photographs, 0 for none")
        if self.neighbors < 2:
            raise ValueError(f"tracker.neighbors={self.neighbors}: a photograph needs two others or more")


__all__ = ["PhotographsConfig"]
