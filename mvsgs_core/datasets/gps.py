"""GPS of a stream: EXIF's of each photograph, or a file of places by time or by frame name (.csv, .gpx, .srt of DJI).

A file's places of a time are taken to the frames by interpolation, at most one frame for each of them: those between
say nothing new. A place is (latitude, longitude, altitude) in degrees of WGS84 and metres; one without altitude is
none, and neither is (0, 0), which receivers write without a fix.
"""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mvsgs_core import geodesy
from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.georeference import FEWEST
from mvsgs_core.stream_times import LATEST

MAX_BYTES = 2**26
MAX_GAP = 5.0  # seconds between two places, over which nothing is interpolated
CLOCK = 1e8  # seconds: more is a time since 1970, less since a stream's beginning
_LATITUDE, _LONGITUDE = ("latitude", "lat", "gps_latitude"), ("longitude", "lon", "lng", "long", "gps_longitude")
_ALTITUDE = ("altitude", "alt", "ele", "elevation", "height", "abs_alt", "gps_altitude")
_TIME = ("time", "timestamp", "t", "seconds", "datetime", "date")
_NAME = ("name", "frame", "file", "filename", "image", "sourcefile", "file_path")
_SRT_TIME = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_NUMBER = r"\s*[:=(]?\s*([-+]?\d+(?:\.\d+)?)"
_SRT_PLACE = (  # the drones' firmwares differ; DJI writes "longtitude" in some
    re.compile(rf"latitude{_NUMBER}.*?long?t?itude{_NUMBER}", re.IGNORECASE | re.DOTALL),
    re.compile(r"GPS\s*\(\s*(?P<lon>[-+]?\d+\.\d+)\s*,\s*(?P<lat>[-+]?\d+\.\d+)", re.IGNORECASE),
)
_SRT_ALTITUDE = tuple(  # above the sea, then above the place of the start
    re.compile(text + _NUMBER, re.IGNORECASE) for text in (r"abs_alt", r"altitude", r"rel_alt", r"BAROMETER", r"\bH\b")
)


@dataclass(frozen=True)
class GpsTrack:
    """The places of a file: by frame name, else in the order of time."""

    named: list[tuple[str, np.ndarray]]  # names as the file gives them, with folders, in lower case
    seconds: np.ndarray  # (N,) of `places`, ascending
    places: np.ndarray  # (N, 3)
    warnings: list[str] = field(default_factory=list)

    @property
    def on_a_clock(self) -> bool:
        """Whether its times are since 1970, and not since the stream's beginning."""
        return len(self.seconds) > 0 and float(self.seconds[0]) > CLOCK

    @property
    def misses(self) -> str:
        """What to say where no frame's name or time is in it."""
        if not self.named:
            return "neither their names nor their times are in it"
        return f"it names {self.named[0][0]!r}; give it the names of the images, or of a video's frames the times"

    def places_by_name(self, frames: Sequence[Path]) -> tuple[dict[Path, np.ndarray], list[Path]]:
        """Places of the frames that are named, and frames that have none because their names are of several.

        A frame is found under its name with or without its suffix, where there are several by the longest end of both
        paths; one in another folder suits less than one without a folder. A name is of the frames of one folder: of
        several that it would suit, those that it suits best have it.
        """
        names: dict[str, list[int]] = defaultdict(list)
        for n, (name, _) in enumerate(self.named):
            names[name.rpartition("/")[2]].append(n)
        suits: dict[int, list[tuple[int, Path]]] = defaultdict(list)  # by name: how well, and which frame
        unsure: list[Path] = []
        for frame in frames:
            found = names.get(frame.name.lower()) or names.get(frame.stem.lower(), [])
            folders = frame.parent.as_posix().lower()
            ends = [self.named[n][0].rpartition("/")[0] for n in found]
            fit = [_common_end(end, folders) or -bool(end) for end in ends]
            best = [n for n, length in zip(found, fit) if length == max(fit)]
            if len({tuple(self.named[n][1]) for n in best}) == 1:
                suits[best[0]].append((max(fit), frame))
            elif best:
                unsure.append(frame)
        places = {}
        for n, candidates in suits.items():
            best_frames = [frame for fit, frame in candidates if fit == max(candidates)[0]]
            if len({frame.parent for frame in best_frames}) == 1:
                places.update(dict.fromkeys(best_frames, self.named[n][1]))
            else:
                unsure += best_frames
        return places, unsure


class PlacesInTime:
    """Places of a stream's frames by their timestamps, each asked once, in the order of the stream."""

    def __init__(self, track: GpsTrack, start: float | None) -> None:
        """start: when timestamp 0 was, seconds since 1970; None: not known."""
        self._track, self._start = track, start
        self._longitude = np.unwrap(track.places[:, 1], period=360.0)
        changed = np.ones(len(track.seconds), bool)  # a receiver's fix is repeated until the next one
        changed[1:] = (track.places[1:] != track.places[:-1]).any(axis=1)
        self._fix = np.cumsum(changed)
        self._last_fix = -1
        self._frames = self._within = self._placed = 0  # frames, those within the file's times, those with a place
        self._first, self._last = np.inf, -np.inf  # of the frames' times, as the file counts them

    def place(self, timestamp: float) -> np.ndarray | None:
        """(3,), None where there is none, or none that is new."""
        seconds, places = self._track.seconds, self._track.places
        now = timestamp + (self._start or 0.0)
        self._frames, self._first, self._last = self._frames + 1, min(self._first, now), max(self._last, now)
        after = int(np.searchsorted(seconds, now))
        before = int(np.searchsorted(seconds, now, side="right")) - 1
        if before < 0 or after >= len(seconds):
            return None
        self._within += 1
        if self._fix[before] == self._last_fix:
            return None
        if seconds[after] - seconds[before] > MAX_GAP:
            return None
        self._last_fix = int(self._fix[before])
        self._placed += 1
        return np.array([np.interp(now, seconds, column) for column in (places[:, 0], self._longitude, places[:, 2])])

    def doubt(self) -> str:
        """What of the times left most frames without a place, and what to do; empty where they do not."""
        seconds = self._track.seconds
        remedy = self._remedy() if len(seconds) and self._frames else ""
        unnamed = " that it does not name" if self._track.named else ""
        return remedy and (
            f"a place for {self._placed} of {self._frames} frames{unnamed}: its times are {_told(seconds[0])} to "
            f"{_told(seconds[-1])}, the frames' {_told(self._first)} to {_told(self._last)}; {remedy}"
        )

    def _remedy(self) -> str:
        seconds, clock = self._track.seconds, self._track.on_a_clock
        if 2 * self._within < self._frames:
            if clock and self._start is not None:
                return "is it another time zone? dataset.gps_start says when the first frame was, with its zone"
            if clock or self._first > CLOCK:
                return "is it another clock, or time zone? Write them by the clock of the frames"
            return "is it another unit, or beginning? Write them in seconds from the first frame"
        begin = max(int(np.searchsorted(seconds, self._first, side="right")) - 1, 0)
        apart = np.diff(seconds[begin : int(np.searchsorted(seconds, self._last)) + 1])
        if self._placed < FEWEST and len(apart) and np.median(apart) > MAX_GAP:
            told = f"between two that are {np.median(apart):.6g} s apart, over {MAX_GAP:g} s, nothing is interpolated: "
            return told + ("record more of them" if clock else "are they milliseconds? Write them in seconds")
        return "" if self._placed else "the frames are in a gap of them: record places without one"


def _told(seconds: float) -> str:
    if not CLOCK < seconds < LATEST:
        return f"{seconds:.6g} s"
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def _common_end(one: str, other: str) -> int:
    """How many folders two paths end with alike."""
    length = 0
    for a, b in zip(reversed(one.split("/")), reversed(other.split("/"))):
        if a != b or not a:
            break
        length += 1
    return length


def read_gps(path: Path) -> GpsTrack:
    """The places in a .csv, .tsv or .txt with a header, a .gpx, or a .srt. Raises BadFileError and OSError."""
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise BadFileError(f"{path}: GPS is read from {', '.join(_PARSERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: a file of GPS places, or leave dataset.gps away")
    with reading(path, "is no file of GPS places"):
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES >> 20} MB")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        named: list[tuple[str, np.ndarray]] = []
        timed: list[tuple[float, np.ndarray]] = []
        without = 0
        for key, place in parse(text):
            if place is None:
                without += 1
            elif isinstance(key, str):
                named.append((key, place))
            else:
                timed.append((key, place))
        if not named and not timed:
            raise ValueError(f"it has no place, of {without} entries: latitude, longitude and altitude are needed")
        timed.sort(key=lambda entry: entry[0])
        seconds = np.array([entry[0] for entry in timed])
        if len(seconds) and not (seconds[-1] < CLOCK or CLOCK < seconds[0] < seconds[-1] + 1 < 1e11):
            raise ValueError("its times are neither seconds of the stream nor since 1970, nor of ISO 8601")
        warnings = [f"entries of {path.name} without a place that can be used: {without}"] if without else []
        return GpsTrack(named, seconds, np.array([entry[1] for entry in timed]).reshape(-1, 3), warnings)


def clock_time(text: str) -> float:
    """Seconds since 1970 of ISO 8601; UTC where it names no zone. Raises ValueError."""
    found = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


_Entry = tuple[str | float, np.ndarray | None]  # a frame's name or a time, and the place


def _csv(text: str) -> Iterator[_Entry]:
    lines = [line for line in text.splitlines() if line.strip()]
    header = lines[0].lstrip("# ") if lines else ""
    rows = csv.reader([header, *lines[1:]], delimiter=max(",;\t", key=header.count), skipinitialspace=True)
    columns = [column.strip().lower() for column in next(rows, [])]

    def find(names: tuple[str, ...], wanted: str) -> int:
        place = next((columns.index(name) for name in names if name in columns), -1)
        if place < 0 and wanted:
            raise ValueError(f"its header has no {wanted} ({', '.join(names)}): {', '.join(columns)[:200]!r}")
        return place

    at = [find(_LATITUDE, "latitude"), find(_LONGITUDE, "longitude"), find(_ALTITUDE, "altitude")]
    named = find(_NAME, "")
    key = named if named >= 0 else find(_TIME + _NAME, "time or frame name")
    for number, row in enumerate(rows, start=2):
        try:
            values = [row[column].strip() for column in at]
            place = np.array([float(value) for value in values]) if all(values) else None
            by = row[key].strip().replace("\\", "/").lower() if named >= 0 else _seconds(row[key])
        except (ValueError, IndexError) as error:
            raise ValueError(f"line {number}, {','.join(row)[:120]!r}: {error}") from None
        yield by, _checked(place, f"line {number}")


def _seconds(text: str) -> float:
    """Of the stream or since 1970. Raises ValueError for what is neither a number nor ISO 8601, and for NaN."""
    try:
        seconds = float(text)
    except ValueError:
        return clock_time(text)
    if not math.isfinite(seconds):
        raise ValueError(f"{text} is no time")
    return seconds


def _gpx(text: str) -> Iterator[_Entry]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it defines entities, which GPX needs not")
    found: dict[str, list[ElementTree.Element]] = {}
    for element in ElementTree.fromstring(text).iter():
        found.setdefault(element.tag.rpartition("}")[2], []).append(element)
    points = found.get("trkpt") or [*found.get("wpt", []), *found.get("rtept", [])]  # beside a track they are marks
    for number, point in enumerate(points, start=1):
        inner = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        by: str | float
        if time := inner.get("time"):
            by = clock_time(time)
        elif name := inner.get("name"):
            by = name.replace("\\", "/").lower()
        else:
            raise ValueError(f"point {number} has neither time nor name")
        ele = inner.get("ele")
        place = np.array([float(point.get("lat", "")), float(point.get("lon", "")), float(ele)]) if ele else None
        yield by, _checked(place, f"point {number}")


def _srt(text: str) -> Iterator[_Entry]:
    times = list(_SRT_TIME.finditer(text))
    for found, following in zip(times, [*times[1:], None]):
        hours, minutes, seconds, fraction = found.groups()
        begin = 3600.0 * int(hours) + 60.0 * int(minutes) + int(seconds) + int(fraction) / 10.0 ** len(fraction)
        block = re.sub(r"<[^>]*>", "", text[found.end() : following.start() if following else len(text)])
        where = next((match for pattern in _SRT_PLACE if (match := pattern.search(block))), None)
        height = next((match for pattern in _SRT_ALTITUDE if (match := pattern.search(block))), None)
        if where is None or height is None:
            yield begin, None
            continue
        latitude, longitude = (where["lat"], where["lon"]) if "lat" in where.groupdict() else where.groups()
        place = np.array([float(latitude), float(longitude), float(height.group(1))])
        yield begin, _checked(place, f"the subtitle at {begin:.2f} s")


def _checked(place: np.ndarray | None, where: str) -> np.ndarray | None:
    """None without a fix. Raises ValueError for what can be no place."""
    if place is None or (place[0] == 0.0 and place[1] == 0.0):
        return None
    if not geodesy.is_place(place):
        raise ValueError(f"{where}: latitude {place[0]:g}, longitude {place[1]:g}, altitude {place[2]:g} are no place")
    return place


_PARSERS: dict[str, Callable[[str], Iterator[_Entry]]] = {
    ".csv": _csv, ".tsv": _csv, ".txt": _csv, ".gpx": _gpx, ".srt": _srt,
}  # fmt: skip

__all__ = ["CLOCK", "GpsTrack", "PlacesInTime", "clock_time", "read_gps"]
