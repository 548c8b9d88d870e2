"""Videos with what is fixed to the camera drawn over them, tracked: `python -m bench.fixed_parts`.

Bars above and below, bars at the sides, a line of text that counts seconds, a hood at the lower rim. Each as it is
(dataset.hide_fixed=false), with the masks that are found, and with the mask that is known because it was drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from bench.table import Row, at_least, at_most, main
from bench.tracking.__main__ import run
from bench.tracking.cases import CASES, Case, missing
from mvsgs_core.datasets import Item
from mvsgs_core.stats import Stats
from nodes.fixed_mask import FixedMask

VIDEOS = {name: CASES[name] for name in ("tum_fr1_xyz", "redkitchen", "icl_nuim_of_kt0", "kitti_piece", "hololens_000")}
QUICK = {"room": Case("synthetic", {"frames": 90, "threads": 1})}
FALSE, COVERED, TIMES = 0.001, 0.8, 1.25  # goals
AGREES = 0.1  # cm: errors that differ by less are alike

Drawn = tuple[np.ndarray, np.ndarray]  # (H, W, 3) uint8, and (H, W) bool: where something was drawn


def bars(image: np.ndarray, seconds: float) -> Drawn:
    where = np.zeros(image.shape[:2], bool)
    thick = image.shape[0] // 10
    where[:thick] = where[-thick:] = True
    return np.where(where[..., None], np.uint8(0), image), where


def side_bars(image: np.ndarray, seconds: float) -> Drawn:
    where = np.zeros(image.shape[:2], bool)
    thick = image.shape[1] // 8
    where[:, :thick] = where[:, -thick:] = True
    return np.where(where[..., None], np.uint8(0), image), where


def text(image: np.ndarray, seconds: float) -> Drawn:
    """In white with a dark rim, as cameras write it."""
    shown, height = image.copy(), image.shape[0]
    written = f"2026-11-27 10:12:{int(seconds) % 60:02d}  52 km/h  N48.13743 E11.57549"
    place, scale = (height // 40, height - height // 40), height / 800.0
    for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(shown, written, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, thick, cv2.LINE_AA)
    return shown, np.any(shown != image, axis=-1)


def hood(image: np.ndarray, seconds: float) -> Drawn:
    """A curved surface with what it mirrors, always the same."""
    height, width = image.shape[:2]
    v, u = np.mgrid[:height, :width]
    where = v > height * (0.82 + 0.3 * ((u - width / 2) / width) ** 2)
    spots = np.random.default_rng(1).normal(60.0, 25.0, (height // 8, width // 8, 3)).clip(0, 255).astype(np.uint8)
    surface = cv2.resize(spots, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(where[..., None], surface, image), where


DRAWN: dict[str, Callable[[np.ndarray, float], Drawn]] = {
    "bars": bars, "bars at the sides": side_bars, "text": text, "hood": hood,
}  # fmt: skip


def found_in(items: Sequence[Item]) -> list[Item]:
    return list(FixedMask(Stats(), True).masked_ahead(items))


def tracked(name: str, items: Sequence[Item]) -> tuple[list[Row], float, int]:
    """Rows, the error in cm, and the frames without a pose."""
    result = run(items)
    error = 100.0 * result.worst
    shown = Row(f"{name}: error", error if np.isfinite(error) else None, "cm")
    unposed = Row(f"{name}: without a pose", result.unposed, f"of {len(items)}")
    return [shown, *result.unknown(name), unposed], error, result.unposed


def with_drawn(name: str, items: Sequence[Item], draw: Callable[[np.ndarray, float], Drawn]) -> list[Row]:
    start, shown, wheres = items[0].timestamp, list[Item](), list[np.ndarray]()
    for item in items:
        image, where = draw(item.image, item.timestamp - start)
        shown.append(replace(item, image=image))
        wheres.append(where)
    found = found_in(shown)
    left_out = [np.zeros_like(where) if item.mask is None else ~item.mask for item, where in zip(found, wheres)]
    covered = float(np.mean([(out & where).sum() / where.sum() for out, where in zip(left_out, wheres)]))
    beside = float(np.mean([(out & ~where).mean() for out, where in zip(left_out, wheres)]))
    known = [replace(item, mask=~where) for item, where in zip(shown, wheres)]
    rows, _, _ = tracked(f"{name}, as it is", shown)
    masked, error, unposed = tracked(f"{name}, masks found", found)
    ideal, best, best_unposed = tracked(f"{name}, mask known", known)
    worst = max(TIMES * best, best + AGREES)
    return [
        *rows, *masked, *ideal,
        at_least(f"{name}, masks found: of what was drawn", covered, "", COVERED),
        Row(f"{name}, masks found: of the image beside it", beside),
        at_most(f"{name}, masks found: error, goal from the known mask", error, "cm", worst),
        at_most(f"{name}, masks found: without a pose, goal from the known mask", unposed, "", best_unposed),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    videos = QUICK if options.quick else VIDEOS
    rows = missing(videos)
    for name, case in videos.items():
        if not case.there:
            continue
        items = [replace(item, depth=None) for item in case.items()]
        wrong = float(np.mean([0.0 if item.mask is None else 1.0 - item.mask.mean() for item in found_in(items)]))
        rows.append(at_most(f"{name}: of the image masked with nothing drawn", wrong, "", FALSE))
        rows += tracked(name, items)[0]
        for what, draw in DRAWN.items():
            rows += with_drawn(f"{name}, {what}", items, draw)
            print(rows[-2], flush=True)
    return rows


if __name__ == "__main__":
    main(measure, "What is fixed to the camera")
