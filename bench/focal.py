"""Focal lengths estimated from video whose camera nobody told: `python -m bench.focal`.

Every video and its parts, tracked from a guess of 65 degrees across the longer side, principal point in the middle.
What the tracker estimates, and how sure it says it is, against the calibration that came with the data. Then whole
videos with a calibration that is given, as it came and wrong by a twentieth: whether the contradiction is said. Then
with the picture magnified from its middle on, as by a zoom: whether that is said.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bench.table import Row, at_least, at_most, main
from bench.tracking.cases import CASES, Case, missing
from bench.tracking.track import track
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.lens import guess_lens

STREET, HEAD = "kitti_piece", "hololens_000"
VIDEOS = {
    **{name: CASES[name] for name in ("tum_fr1_xyz", "redkitchen, color camera 525", "icl_nuim_of_kt0")},
    STREET: Case("tum", {"size": (185, 613)}, STREET),
    HEAD: Case("tum", {"size": (180, 270)}, HEAD),
    **{name: CASES[name] for name in ("tum_fr3_structure_notexture_far", "room", "room, loop", "aerial")},
}
AHEAD = "tum_fr1_xyz, 24 frames, straight ahead at first"  # whose first keyframes want another focal length
STRAIGHT = Case("tum", {"stride": 2, "stop": 48}, "tum_fr1_xyz")
PART = 80  # frames
WRONG = 0.05  # fraction by which a calibration that is given is off
ZOOMS, ZOOMING = (1.1, 1.2, 1.5), 30  # times; frames that a zoom takes
QUICK = {"room": Case("synthetic", {"frames": 60, "threads": 1})}
MEDIAN_ERROR, SURE_ERROR, INTERVAL, WITHIN = 2.0, 5.0, 2.0, 0.9  # %, %, standard deviations, share


@dataclass(frozen=True)
class Estimate:
    """Of one stream; `error` and `sigma` in percent of the focal length."""

    name: str
    start: float  # error of the guess
    error: float
    sigma: float | None  # None: it was not estimated, the guess is kept
    doubt: str

    @property
    def sure(self) -> bool:
        return self.sigma is not None and not self.doubt

    def row(self) -> Row:
        said = f", doubted: {self.doubt}" if self.doubt else ""
        return Row(f"{self.name}, {self.start:+.0f} % at the start{said}", self.error, "%", spread=self.sigma)


def parts(name: str, items: Sequence[Item]) -> Iterator[tuple[str, Sequence[Item]]]:
    """The whole, and where it is longer than a part each full part."""
    yield name, items
    if len(items) >= 2 * PART:
        for start in range(0, len(items) - PART + 1, PART):
            yield f"{name}, frames {start} to {start + PART - 1}", items[start : start + PART]


def estimate(name: str, items: Sequence[Item]) -> Estimate:
    height, width = items[0].image.shape[:2]
    guess = np.array(guess_lens((height, width)).intrinsics)
    guessed = (replace(i, index=n, intrinsics=guess, intrinsics_guessed=True) for n, i in enumerate(items))
    tracker = track(guessed).tracker
    truth = float(np.mean(items[0].intrinsics[:2]))
    values = tracker.stats.values
    sigma = values.get("focal_sigma_percent")
    return Estimate(
        name,
        100.0 * float(guess[0] / truth - 1.0),
        100.0 * float(guess[0] * tracker.focal_factor / truth - 1.0),
        None if sigma is None else float(sigma),
        str(values.get("focal_doubt", "")),
    )


@dataclass(frozen=True)
class Given:
    """A whole video with a calibration that is given; `found`: what the tracker says fits better, None if nothing."""

    name: str
    off: float  # of the calibration that came with the data, as a fraction
    found: float | None  # the same, of the focal length that the keyframes are said to want
    zoom: float | None  # by which the camera is said to have zoomed
    zoomed: float = 1.0

    def row(self) -> Row:
        if self.zoomed != 1.0:
            name = f"{self.name}, zoomed by {self.zoomed:.1f}"
            return Row(name, "nothing said") if self.zoom is None else Row(f"{name}: said", self.zoom, "")
        name = f"{self.name}, given {100.0 * self.off:+.0f} %"
        return Row(name, "nothing said") if self.found is None else Row(f"{name}: wanted", 100.0 * self.found, "%")


def given(name: str, items: Sequence[Item], off: float, zoomed: float = 1.0) -> Given:
    """zoomed: by so much through the frames from the middle one on."""

    def seen(n: int, item: Item) -> Item:
        part = np.clip((n - len(items) / 2) / ZOOMING, 0.0, 1.0)
        image = magnified(item, 1.0 + (zoomed - 1.0) * part) if zoomed != 1.0 else item.image
        told = item.intrinsics * [1.0 + off, 1.0 + off, 1.0, 1.0]
        return replace(item, index=n, image=image, intrinsics=told, intrinsics_guessed=False)

    tracker = track(seen(n, item) for n, item in enumerate(items)).tracker
    values = tracker.stats.values
    found = values.get("focal_checked_px")
    wanted = None if found is None else float(found) / float(items[0].intrinsics[0]) - 1.0
    return Given(name, off, wanted, values.get("zoom"), zoomed)


def magnified(item: Item, times: float) -> np.ndarray:
    """(H, W, 3) uint8, about the principal point."""
    (height, width), (x, y) = item.image.shape[:2], item.intrinsics[2:]
    turn = np.array([[times, 0.0, (1.0 - times) * x], [0.0, times, (1.0 - times) * y]])
    return cv2.warpAffine(item.image, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def summary(found: Sequence[Estimate]) -> list[Row]:
    """What is asked of all streams together."""
    sure = [abs(one.error) for one in found if one.sure]
    stated = [one for one in found if one.sigma is not None]
    inside = [one for one in stated if abs(one.error) <= INTERVAL * (one.sigma or 0.0)]
    median = float(np.median([abs(one.error) for one in found]))
    rows = [at_most(f"median error of {len(found)} streams", median, "%", MEDIAN_ERROR)]
    if sure:
        rows.append(at_most(f"largest error of the {len(sure)} that claim to be sure", max(sure), "%", SURE_ERROR))
    if stated:
        share = len(inside) / len(stated)
        rows.append(at_least(f"of {len(stated)} that state how sure: truth within two sigma", share, "", WITHIN))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    found, known, zooms = list[Estimate](), list[Given](), list[Given]()
    videos = QUICK if options.quick else VIDEOS
    for name, case in videos.items():
        if case.there:
            items = [replace(item, depth=None) for item in case.items()]
            found += [estimate(part, chosen) for part, chosen in parts(name, items)]
            known += [given(name, items, off) for off in (0.0, -WRONG, WRONG)]
            zooms += [given(name, items, 0.0, zoomed) for zoomed in ZOOMS]
            print(found[-1], *known[-3:], *zooms[-len(ZOOMS) :], sep="\n", flush=True)
    if not options.quick and STRAIGHT.there:
        known.append(given(AHEAD, [replace(item, depth=None) for item in STRAIGHT.items()], 0.0))
    exact = [one for one in known if one.off == 0.0 and one.name.startswith("room")]  # of rendered images
    wrong = [one for one in known if one.off != 0.0 and one.name.startswith("room")]
    still, said = sum(one.zoom is not None for one in known), [one for one in zooms if one.zoom is not None]
    blamed = sum(one.found is not None for one in exact)
    told = sum(one.found is not None and abs(one.found) < WRONG / 2.0 for one in wrong)
    return [
        *missing(videos),
        *(one.row() for one in found),
        *summary(found),
        *(one.row() for one in known),
        at_most("room: of right ones, called wrong", blamed, f"of {len(exact)}", 0),
        at_least("room: of wrong ones, mended by half at least", told, f"of {len(wrong)}", len(wrong)),
        *(one.row() for one in zooms),
        at_most("videos without a zoom, said to have one", still, f"of {len(known)}", 0),
        Row("videos with a zoom, said to have one", len(said), f"of {len(zooms)}"),
    ]


if __name__ == "__main__":
    main(measure, "Focal lengths of video without a calibration")
