"""What of a stream is wanted: options that its sources share. A null stop is the stream's end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mvsgs_core.datasets.framing import target_size


@dataclass(kw_only=True, eq=False)
class Selection:
    """Which frames. Raises ValueError for none."""

    start: int = 0  # first frame, counted from the stream's first
    stop: int | None = None  # frame to stop before; null: the end
    stride: int = 1  # every which frame

    def __post_init__(self) -> None:
        if not self.start >= 0 or self.stride < 1 or (self.stop is not None and self.stop <= self.start):
            wanted = f"start={self.start}, stop={self.stop}, stride={self.stride}"
            raise ValueError(f"{wanted}: 0 <= start < stop (or null) and stride >= 1")

    @property
    def wanted(self) -> slice:
        return slice(self.start, self.stop, self.stride)

    def has(self, number: int) -> bool:
        """Whether a frame of this number, from 0, is wanted."""
        past = self.stop is not None and number >= self.stop
        return number >= self.start and not past and (number - self.start) % self.stride == 0


@dataclass(kw_only=True, eq=False)
class SizedSelection(Selection):
    """Which frames, and how large. Raises ValueError for a size that is none."""

    # [height, width], or a number of pixels at the same aspect; null: as it is, up to 1.5 million pixels
    size: list[int] | int | None = None
    # image whose black pixels are ignored in each frame; of image files also a folder of masks, null: masks/ beside
    mask: str | Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        target_size(self.size, (480, 640))


@dataclass(kw_only=True, eq=False)
class FileOptions(SizedSelection):
    """What every reader of files takes."""

    path: str | Path | None = None  # folder or file
    # [fx, fy, cx, cy] in pixels of the original image; auto: the tracker estimates them; null: the data set's own
    intrinsics: Sequence[float] | str | None = None
    # with intrinsics, or EXIF's, as in OpenCV: [k1, k2, p1, p2(, k3, ...)], or [fisheye, k1, k2, k3, k4]
    distortion: Sequence[float | str] = field(default_factory=list)
    # places of the frames by time or name: .csv with a header, .gpx, or .srt as DJI writes it; null: EXIF's
    gps: str | Path | None = None
    # when timestamp 0 was, ISO 8601, for a gps file whose times are of a clock; null: as a video says when it began
    gps_start: str | None = None
