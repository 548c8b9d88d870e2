"""Videos with a person drawn into them who walks through the picture, tracked: `python -m bench.moving`.

The person is cut out of the video itself, swings as it walks, and covers a fifth to half of the picture's width. Each
video as it is, with the person, and with the person masked by the mask that is known because it was drawn.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from bench.fixed_parts import AGREES, TIMES, tracked
from bench.table import Row, at_most, main
from bench.tracking.cases import CASES, Case, missing
from mvsgs_core.datasets import Item

VIDEOS = {name: CASES[name] for name in ("redkitchen", "tum_fr1_xyz", "room")}
QUICK = {"room": Case("synthetic", {"frames": 90, "threads": 1})}
WIDTHS, PERIODS = (0.2, 0.35, 0.5), (60, 120)  # of the picture's width; frames from one side to the other and back


def person(size: tuple[int, int], width: float, phase: float, stride: float) -> np.ndarray:
    """Where a person is: (H, W) bool. width: pixels; phase: 0 to 1, from beyond one side to beyond the other."""
    rows, columns = size
    v, u = np.mgrid[:rows, :columns].astype(np.float32)
    at = -width / 2 + phase * (columns + width)
    down = v / rows  # the head at .22, the feet below the picture
    lean = 0.08 * width * np.sin(stride) * (down - 0.5)
    across = (u - at - lean) / (width / 2)
    head = (across / 0.35) ** 2 + ((down - 0.22) / 0.11) ** 2 < 1.0
    body = (across / 0.75) ** 2 + ((down - 0.58) / 0.28) ** 2 < 1.0
    step = 0.4 * np.sin(stride) * (down - 0.7) / 0.3
    legs = (down > 0.7) & ((np.abs(across - 0.3 - step) < 0.26) | (np.abs(across + 0.3 + step) < 0.26))
    arms = (np.abs(across - (0.75 + step * 0.5) * np.sign(across)) < 0.18) & (down > 0.4) & (down < 0.7)
    return np.asarray(head | body | legs | arms)


def with_person(items: Sequence[Item], share: float, period: int) -> tuple[list[Item], list[np.ndarray]]:
    """The frames with a person, and where he is: (H, W) bool each. share: of the picture's width."""
    cloth = items[len(items) // 2].image[:, ::-1]  # mirrored, so that it is no place of the video
    rows, columns = cloth.shape[:2]
    v, u = np.mgrid[:rows, :columns].astype(np.float32)
    shown, wheres = list[Item](), list[np.ndarray]()
    for n, item in enumerate(items):
        there = (n / period) % 1.0
        phase = 1.0 - abs(2.0 * there - 1.0)
        stride = 2.0 * np.pi * n / 25.0
        where = person((rows, columns), share * columns, phase, stride)
        moved = -share * columns / 2 + phase * (1.0 + share) * columns - columns / 2
        swing = 0.03 * share * columns * np.sin(stride + v / rows * 6.0)  # cloth that moves
        worn = cv2.remap(
            cloth, u - np.float32(moved) + swing, v + 0.3 * swing, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        shown.append(replace(item, image=np.where(where[..., None], worn, item.image)))
        wheres.append(where)
    return shown, wheres


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    videos = QUICK if options.quick else VIDEOS
    rows, errors, ideals = missing(videos), list[float](), list[float]()
    widths, periods = ((0.35,), (60,)) if options.quick else (WIDTHS, PERIODS)
    for name, case in videos.items():
        if not case.there:
            continue
        items = [replace(item, depth=None) for item in case.items()]
        rows += tracked(name, items)[0]
        for width, period in itertools.product(widths, periods):
            shown, wheres = with_person(items, width, period)
            what = f"{name}, person of {100 * width:.0f} % in {period} frames"
            known, best, best_unposed = tracked(
                f"{what}, mask known", [replace(i, mask=~w) for i, w in zip(shown, wheres)]
            )
            _, error, unposed = tracked(what, shown)
            worst = max(TIMES * best, best + AGREES)
            rows += [
                *known,
                at_most(f"{what}: error, goal from the known mask", error, "cm", worst),
                at_most(f"{what}: without a pose, goal from the known mask", unposed, "", best_unposed),
            ]
            print(rows[-2], flush=True)
            errors.append(error)
            ideals.append(best)
    if not errors:
        return rows
    mean, ideal = (float(np.exp(np.mean(np.log(each)))) for each in (errors, ideals))
    return [*rows, Row("all, geometric mean: error", mean, "cm"), Row("all, mask known: error", ideal, "cm")]


if __name__ == "__main__":
    main(measure, "What moves")
