"""ScanNet's own files (.sens, version 4), as https://github.com/ScanNet/ScanNet describes them, without exporting."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import Item, dataset
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.files import MAX_PIXELS, Layout, UnreadableImageError, read_image, visible
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import is_rigid
from mvsgs_core.datasets.registration import register
from mvsgs_core.datasets.sequence import FileReader

LAYOUT = Layout(
    "ScanNet",
    "a file such as scene0000_00.sens, or the folder that it is in",
    "http://www.scan-net.org; dataset=scannet reads what its SensReader exports",
)
FRAME_RATE = 30.0  # the files give most frames no time
_VERSION = 4
_MATRIX = struct.Struct("<16f")
_SIZES = struct.Struct("<iiIIIIfQ")  # compression of color and depth, widths and heights, counts a meter, frames
_FRAME = struct.Struct("<16fQQQQ")  # camera to world, times of color and depth, bytes of color and depth
_RAW_COLOR, _COLOR = 0, (0, 1, 2)  # by a number: raw, PNG, JPEG
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_UNKNOWN = (0, 65535)  # counts of depth
_MAX_NAME = 2**16  # bytes, of the sensor
_MORE = 2**20  # bytes that an image may have beyond those of its pixels


@dataclass(frozen=True)
class _Header:
    color: Lens
    depth: Lens
    color_compression: int
    depth_compression: int
    per_meter: float
    frames: int  # that there should be


@dataclass(frozen=True)
class _Frame:
    """Where a frame's bytes lie."""

    world_from_cam: np.ndarray | None  # (4, 4) float64
    at: int
    color_bytes: int
    depth_bytes: int


@dataset
@dataclass(kw_only=True, eq=False)
class Sens(FileReader):
    """A scan. Depth maps are the depth camera's, moved to the color camera's intrinsics at their own size.

    Raises FileNotFoundError and ValueError, which say what was expected, BadFileError for a file that cannot be read.
    """

    @staticmethod
    def recognizes(path: Path) -> bool:
        if path.is_file():
            return path.suffix.lower() == ".sens"
        return _file_in(path) is not None and not (path / "color").is_dir()  # else something was exported to it

    def __post_init__(self) -> None:
        super().__post_init__()
        self._path = _file(LAYOUT.present(self.path))
        with self._path.open("rb") as file, reading(self._path, "is no .sens file that can be read"):
            self._header = _read_header(file)
            self._frames = list(_read_frames(file, self._path.stat().st_size, self._header))
        if len(self._frames) < self._header.frames:
            text = f"{self._path.name} was cut off or is damaged: read are {len(self._frames)} of {self._header.frames}"
            self.warnings.append(f"{text} frames")
        self._lens = self._header.color
        if self.intrinsics is not None:
            self._lens, notes = lens_from_option(self.intrinsics, self.distortion, self._header.color.size)
            self.warnings += notes
        self._check_distortion(self._lens)
        count, self._frames = len(self._frames), self._frames[self.wanted]
        if not self._frames:
            raise ValueError(f"no frame left: {self._path.name} has {count}, wanted from {self.start}")
        missing = sum(frame.world_from_cam is None for frame in self._frames)
        if missing:
            self.warnings.append(f"{missing} of {len(self._frames)} frames have no true pose")
        self._open_mask(self._lens.size)
        self.warnings += self._framing.notice(self._lens.size)
        self._opening_warnings = len(self.warnings)

    @property
    def lens(self) -> Lens:
        """Of the color camera, at the size of its images."""
        return self._lens

    def __len__(self) -> int:
        """Frames selected; those that turn out unreadable are not delivered."""
        return len(self._frames)

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)
        index, numbers = 0, range(self._header.frames)[self.wanted]
        with self._path.open("rb") as file:
            for number, frame in zip(numbers, self._frames):
                file.seek(frame.at)
                color, depth = file.read(frame.color_bytes), file.read(frame.depth_bytes)
                try:
                    image = self._image(color, number)
                except UnreadableImageError as error:
                    self._notices.tally("images left out because they could not be read", str(error))
                    continue
                yield self._item(index, number / FRAME_RATE, frame, image, self._depth(depth, number))
                index += 1
        self._end_places()
        if index == 0:
            raise BadFileError("no image could be read: " + "; ".join(self._notices))

    def _item(self, index: int, seconds: float, frame: _Frame, image: np.ndarray, depth: np.ndarray | None) -> Item:
        size = self._framing.size_of(self._lens.size)
        framed, intrinsics = self._framing.image(image, self._lens, size)
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, self._lens, size)
        if depth is not None:
            depth = self._framing.depth(depth, self._lens, size)
        place, guessed = self._place(seconds), self._lens.guessed
        pose, original = frame.world_from_cam, np.array(self._lens.intrinsics, np.float64)
        return Item(index, seconds, framed, intrinsics, pose, depth, guessed, place=place, mask=mask, original=original)

    def _image(self, data: bytes, number: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB. Raises UnreadableImageError."""
        (height, width), name = self._header.color.size, f"frame {number}"
        if self._header.color_compression != _RAW_COLOR:
            image = read_image(BytesIO(data), name=name, turn_upright=False)
        elif len(data) == 3 * height * width:
            image = np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)
        else:
            raise UnreadableImageError(f"{name}: {len(data)} bytes are no image of {width}x{height}")
        if image.shape[:2] != (height, width):
            raise UnreadableImageError(f"{name}: {image.shape[1]}x{image.shape[0]} where {width}x{height} is said")
        return image

    def _depth(self, data: bytes, number: int) -> np.ndarray | None:
        """(h, w) float32 meters as the color camera sees them, None where there is no depth map that can be read."""
        camera, wanted = self._header.depth, 2 * self._header.depth.size[0] * self._header.depth.size[1]
        if not same_shape(camera.size, self._lens.size):
            self._notices.tally("depth maps left out because they have another aspect ratio than their image", "all")
            return None
        try:
            if self._header.depth_compression == _ZLIB_DEPTH:
                data = zlib.decompressobj().decompress(data, wanted + 1)
            if len(data) != wanted:
                raise ValueError(f"{len(data)} bytes, where it has {wanted}")
        except (zlib.error, ValueError) as error:
            what = "depth maps that could not be read, so that depth is not scored there"
            self._notices.tally(what, f"frame {number}: {error}")
            return None
        counts = np.frombuffer(data, dtype="<u2").reshape(camera.size)
        depth = (counts / self._header.per_meter).astype(np.float32)
        depth[np.isin(counts, _UNKNOWN)] = 0.0
        return register(depth, camera, self._lens.at(camera.size), 0.0)


def _file(path: Path) -> Path:
    """The file itself, or that of a folder. Raises FileNotFoundError."""
    if path.is_file():
        return path
    found = _file_in(path)
    if found is None:
        raise LAYOUT.missing(f"{path} has no .sens file, or several")
    return found


def _file_in(folder: Path) -> Path | None:
    """The only one of a folder."""
    found = [path for path in visible(folder, "*.sens") if path.is_file()]
    return found[0] if len(found) == 1 else None


def _read_header(file: BinaryIO) -> _Header:
    """Raises ValueError and struct.error for what is no header."""
    (version,), (length,) = struct.unpack("<I", file.read(4)), struct.unpack("<Q", file.read(8))
    if version != _VERSION or length > _MAX_NAME:
        raise ValueError(f"version {version}; read is {_VERSION}")
    file.seek(length, 1)
    color, _, depth, _ = (_matrix(file.read(_MATRIX.size)) for _ in range(4))  # extrinsics are the identity
    kinds = _SIZES.unpack(file.read(_SIZES.size))
    color_kind, depth_kind, color_width, color_height, depth_width, depth_height, per_meter, frames = kinds
    if color_kind not in _COLOR or depth_kind not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise ValueError(f"color compressed by {color_kind} and depth by {depth_kind}, which is not read")
    if max(color_width * color_height, depth_width * depth_height) > MAX_PIXELS or not 0.0 < per_meter < np.inf:
        raise ValueError("images of a size, or depth of a unit, that cannot be")
    cameras = _lens(color, (color_height, color_width)), _lens(depth, (depth_height, depth_width))
    return _Header(*cameras, color_kind, depth_kind, per_meter, frames)


def _read_frames(file: BinaryIO, size: int, header: _Header) -> Iterator[_Frame]:
    """As many as there are whole, up to one that is longer than an image can be."""
    most = [_MORE + 3 * math.prod(header.color.size), _MORE + 2 * math.prod(header.depth.size)]
    for _ in range(header.frames):
        head = file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            return
        *_, color_bytes, depth_bytes = _FRAME.unpack(head)
        pose, at = _matrix(head[: _MATRIX.size]), file.tell()
        if color_bytes + depth_bytes > size - at or color_bytes > most[0] or depth_bytes > most[1]:
            return
        yield _Frame(pose if is_rigid(pose) else None, at, color_bytes, depth_bytes)
        file.seek(at + color_bytes + depth_bytes)


def _matrix(data: bytes) -> np.ndarray:
    return np.array(_MATRIX.unpack(data), dtype=np.float64).reshape(4, 4)


def _lens(matrix: np.ndarray, size: tuple[int, int]) -> Lens:
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Lens((fx, fy, cx, cy), size)
