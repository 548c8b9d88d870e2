"""Figures that BENCHMARKS.md says in sentences are those that are recorded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.record import DOCUMENT, PAGES, RECORDED, Record
from tests.support.shared_data import ROOT

DECISIONS = ROOT / "docs" / "decisions"

VIDEOS = (  # hand-held, in the room and over the landscape
    "tum_fr1_xyz", "redkitchen", "redkitchen, color camera 525", "icl_nuim_of_kt0", "room", "room, loop",
    "room, motion blur", "room, noise and exposure", "room, gloss", "room, moving object", "room, bare walls", "aerial",
)  # fmt: skip
LARGE = ("tum_fr1_xyz", "redkitchen", "icl_nuim", "tum_fr3_notexture")  # scenes of 640x480
WIDE = ("fountain", "herz_jesu", "fox", "aerial_caliterra", "drone_tractor_orbit", "south_building")


def numbers(benchmark: str, ends: str) -> dict[str, float]:
    """Those of the rows whose names end so, by what stands before."""
    rows = Record.load(benchmark).rows
    found = {row["name"].removesuffix(ends): row["value"] for row in rows if row["name"].endswith(ends)}
    assert found, f"{benchmark} has no row that ends with {ends!r}"
    return {name: float(value) for name, value in found.items() if isinstance(value, int | float)}


def span(values: list[float], digits: int = 0) -> str:
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}"


def poses() -> str:
    ratio, times = (
        numbers("tracking", ": ATE / pycolmap's, same frames"),
        numbers("tracking", ": seconds, pycolmap's / ours"),
    )
    assert max(ratio["tum_fr1_xyz"], ratio["room"]) < 0.5
    shares = span([100.0 / times[name] for name in VIDEOS])
    worst = max(ratio[name] for name in VIDEOS)
    return (
        f"our error is at most {worst:.2f} times COLMAP's, and less than half of it on freiburg1_xyz and the room, at "
        f"{shares} % of its processor time"
    )


def keyframes() -> str:
    each = [1.0 / numbers("scenes", "/full: KF/s")[scene] for scene in LARGE]
    return f"A keyframe of 640x480 costs {span(each, 1)} seconds of two cores"


def light() -> str:
    of_keyframes = max(numbers("photometry", ": gray levels of keyframes").values())
    between = max(numbers("photometry", ": gray levels of frames between").values())
    return f"give gray levels to {of_keyframes:.1f} %, those of frames between keyframes to {between:.1f} %"


def wide() -> str:
    errors, times = (numbers("wide", ends) for ends in (": position error", ": processor time over COLMAP's"))
    drone = errors.pop("drone_tractor_orbit")
    shuffled = numbers("wide", ": position error, from COLMAP's shuffled")["drone_tractor_orbit"]
    assert set(times) == set(WIDE)
    return (
        f"in {span(list(times.values()), 2)} of COLMAP's time, within {max(errors.values()):.2f} % of its positions, "
        f"those of the drone's orbit {shuffled:.2f} or {drone:.2f} %, as COLMAP has them in one order or the other"
    )


def photographs() -> str:
    ahead = numbers("photographs", ": ours minus theirs, equal time")
    drone, south, fountain = (
        f"{abs(ahead[scene]):.1f}".removeprefix("0") for scene in ("drone_tractor_orbit", "south_building", "fountain")
    )
    assert ahead["drone_tractor_orbit"] > 0 > ahead["fountain"]
    return (
        f"the map of the drone's orbit is {drone} dB better than COLMAP's with offline splatting, south_building's "
        f"{south} dB, kitti_piece's {ahead['kitti_piece']:.1f} dB where COLMAP has poses, of a third of it; "
        f"fountain's is {fountain} dB worse"
    )


def known_map() -> str:
    over = sorted(numbers("known_map", ": held-out PSNR of the second half over that of one run over both").values())
    words = {3: ("three", "four", "fourth"), 5: ("five", "six", "sixth")}
    within, cases, last = words[len(over) - 1]
    return f"renders within {-over[1]:.1f} dB of its in {within} of {cases} cases, {-over[0]:.1f} dB in the {last}"


def focal() -> str:
    return f"From video alone it is {numbers('focal', 'median error of 17 streams')['']:.1f} % off in the median"


def live() -> str:
    poses, mapped, latest, lost, refined = (
        list(numbers("live", f": live: {what}").values())
        for what in (
            "frame to pose, 99 %, ms", "keyframe to map, median, s", "keyframe to map, 99 %, s",
            "dB below the unhurried map, at the last frame + 2 s", "dB below the unhurried map, refined",
        )
    )  # fmt: skip
    rows = [row for row in Record.load("live").rows if row["name"].endswith(": live: keyframes in the map")]
    assert len(rows) == len(mapped)
    assert all(row["met"] for row in rows)
    return (
        f"99 % of the poses come within {span(poses)} ms of their frames' capture. All keyframes get into the map, in "
        f"the median {span(mapped, 1)} s after their capture, 99 % within {span(latest, 1)} s. The map is at most "
        f"{max(lost):.1f} dB below the unhurried one two seconds after the last, and within {max(refined):.1f} dB of "
        "it once refined"
    )


def quality() -> str:
    ahead = numbers("baselines", ": ours minus theirs, equal time")
    said = [f"{ahead[scene]:.1f}".removeprefix("0") for scene in ("redkitchen", "tum_fr1_xyz")]
    return f"Held-out frames of both real rooms are {said[0]} and {said[1]} dB better"


def quality_s_time() -> str:
    shares = numbers("baselines", ": time from frames to their PSNR, ours over theirs")
    return f"and {100 * shares['redkitchen']:.0f} and {100 * shares['tum_fr1_xyz']:.0f} % of it to their quality"


def kernels() -> str:
    found = numbers("rasterizer", ": fraction of the roofline")
    gaussian, exact = ([v for name, v in found.items() if name.endswith(kind)] for kind in ("gaussian", "exact"))
    return f"{span(gaussian)} % (Gaussian) and {span(exact)} % (exact) of the machine's roofline"


def messages() -> str:
    return f"messages at {span(list(numbers('transport', ': latency, median, ratio').values()), 1)} times plain pyzmq"


def drive() -> str:
    error = numbers("large", "driven: error of these")[""]
    memory = numbers("large", "driven: the same with 5,000 keyframes, extrapolated")[""]
    return f"4,988 keyframes, stays in one part and errs by {error:.2f} %, in {1e-3 * memory:.1f} GB"


SAID = (
    poses, keyframes, light, wide, photographs, known_map, focal, live, quality, quality_s_time, kernels, messages,
    drive,
)  # fmt: skip


@pytest.mark.parametrize("sentence", SAID, ids=lambda sentence: sentence.__name__)
def test_what_is_said_is_what_is_recorded(sentence: Callable[[], str]) -> None:
    assert sentence() in " ".join(DOCUMENT.read_text().split())


def test_it_is_said_elsewhere_alike() -> None:
    """Of the same records."""
    for page, said in ((PAGES / "tracking.md", poses()), (DECISIONS / "transport.md", messages().split("at ")[1])):
        assert said in " ".join(page.read_text().split()), page.name


def test_the_benchmarks_that_have_a_quick_line_are_named() -> None:
    text = " ".join(DOCUMENT.read_text().split())
    named = text.partition("which there is of ")[2].partition(". One benchmark")[0].replace(" and ", ", ")
    assert named.split(", ") == sorted(file.stem for file in (RECORDED / "quick").glob("*.json"))


def test_a_span_is_of_all() -> None:
    assert span([2.04, 1.0, 1.5], 1) == "1.0 to 2.0"
    assert np.isclose(numbers("focal", "median error of 17 streams")[""], 1.39, atol=0.01)
