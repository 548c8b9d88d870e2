"""Pictures of what `bench.before` ran: the same frames before and after, one compact file a scene.

    python -m bench.pictures FOLDER [--scenes redkitchen,room] [--seed 0] [--to docs/benchmarks]

FOLDER is that benchmark's. Of the held-out frames that are the worst, the median and the best after: the photograph,
both renders and both rendered depths; then a window of the photograph's finest detail, with both errors (x4). The
renders are checked against what each run's report says of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bench.before import SCENES, place
from bench.finished import FinishedRun, frames_of
from bench.runs import ROOT
from bench.table import names
from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation.scoring import colorize, colorize_depth

WIDTH = 240  # of one picture, pixels
QUALITY = 88  # of the JPEG file
PART = 4  # the window of finest detail has one such part of the image's width and height
HEADER = 16  # pixels above a row, for its text


def sheet(before: FinishedRun, after: FinishedRun) -> np.ndarray:
    """(h, w, 3) uint8. Raises ValueError where no frame is held out in both runs."""
    known = set(before.held_out())
    ranked = [index for index in after.held_out() if index in known]
    if not ranked:
        raise ValueError(f"{before.folder} and {after.folder} have no held-out frame in common")
    picks = {"worst": ranked[0], "median": ranked[len(ranked) // 2], "best": ranked[-1]}
    rows = [_row(f"{name} held-out frame, {index}", index, before, after) for name, index in picks.items()]
    return np.vstack([*rows, _detail(picks["median"], before, after)])


def _row(name: str, index: int, before: FinishedRun, after: FinishedRun) -> np.ndarray:
    renders = [run.render(index) for run in (before, after)]
    titles = [name, *(f"{side}: {run.psnr[index]:.2f} dB" for side, run in _sides(before, after)),
              "depth before", "depth after"]  # fmt: skip
    pictures = [after.photograph(index), *(_bytes(r.color) for r in renders)]
    return _strip([*pictures, *(colorize_depth(r.depth) for r in renders)], titles)


def _detail(index: int, before: FinishedRun, after: FinishedRun) -> np.ndarray:
    photograph = after.photograph(index)
    rows, columns = finest(photograph)
    colors = [run.render(index).color[rows, columns] for run in (before, after)]
    wanted = photograph[rows, columns]
    errors = [colorize(np.clip(4 * np.abs(c - wanted / 255.0).mean(axis=2), 0, 1)) for c in colors]
    titles = ["finest detail of the median frame", "before", "after", "error before (x4)", "error after (x4)"]
    return _strip([wanted, *(_bytes(color) for color in colors), *errors], titles)


def finest(photograph: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the window whose gray levels bend most: a `PART` of the image's height and width."""
    gray = cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY).astype(np.float32)
    bend = np.abs(cv2.Laplacian(gray, cv2.CV_32F))
    height, width = gray.shape[0] // PART, gray.shape[1] // PART
    total = cv2.integral(bend)
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def _sides(before: FinishedRun, after: FinishedRun) -> list[tuple[str, FinishedRun]]:
    return [("before", before), ("after", after)]


def _bytes(color: np.ndarray) -> np.ndarray:
    return (np.clip(color, 0, 1) * 255).round().astype(np.uint8)


def _strip(pictures: Sequence[np.ndarray], titles: Sequence[str]) -> np.ndarray:
    """Pictures of one size side by side, each under its title."""
    height = round(pictures[0].shape[0] * WIDTH / pictures[0].shape[1])
    strips = []
    for picture, title in zip(pictures, titles, strict=True):
        head = np.full((HEADER, WIDTH, 3), 255, np.uint8)
        cv2.putText(head, title, (4, HEADER - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
        enlarged = picture.shape[1] < WIDTH
        shown = (
            cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_NEAREST)
            if enlarged
            else resize_image(picture, (height, WIDTH))
        )
        strips.append(np.vstack([head, shown]))
    return np.hstack(strips)


def draw(folder: Path, scene: str, seed: int, file: Path) -> None:
    """Writes the sheet of a scene. Raises FileNotFoundError where its runs are not there, and as `sheet` does."""
    folders = [folder / place(scene, seed, side) / "0" for side in ("before", "after")]
    frames = frames_of(folders[1])
    picture = sheet(*(FinishedRun(path, frames) for path in folders))
    if not cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY]):
        raise OSError(f"could not write {file}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    default = ["redkitchen", "tum_fr1_xyz", "icl_nuim", "room"]
    parser.add_argument("--scenes", type=names(SCENES), default=default, help=f"of {', '.join(SCENES)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "benchmarks", help="folder of the pictures")
    given = parser.parse_args()
    for name in given.scenes:
        target = given.to / f"before_{name}.jpg"
        draw(given.folder, name, given.seed, target)
        print(target)
