"""Maps of photographs beside COLMAP with offline splatting at equal optimization time: `python -m bench.photographs`.

Ours is tracker=photographs and the rest of the graph as it is, the mapper with one thread. Theirs: COLMAP matches all
pairs of the same photographs and estimates focal length and distortion too; its sparse points are trained by our own
rasterizer and optimizer (bench.baselines) on the photographs that are not held out, in as many processor seconds as our
mapper took, with and without an exposure a photograph and at two learning rates; the best by held-out PSNR counts.
Both get photographs without their known distortion. Every 5th is held out: COLMAP poses it with all the others, ours
from the finished map. PSNR is the mean over held-out photographs that both have a pose of.
What ended is kept: --resume goes on, --minutes begins no scene after.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench import pieces
from bench.baselines import colmap_poses, offline
from bench.baselines.colmap_poses import Model
from bench.baselines.offline import Trained
from bench.baselines.ours import Ours, run_ours, why_not
from bench.runs import QUICK, choices, figure, folder
from bench.table import Row, at_least, failed, main, names

SCENES = ("fountain", "kitti_piece", "drone_tractor_orbit", "south_building")
GIVEN = ("tracker=photographs", "evaluator.fitted=false")
BEHIND = -1.0  # dB that ours may be behind
COVERED = 97.0  # % of the held-out photographs' pixels
# of which theirs is the best; on all photographs that are not held out, whether or not ours has a pose of them
WAYS: dict[str, tuple[Any, ...]] = {"frames": ("all",), "exposure": ("none", "trained"), "rates": tuple(offline.RATES)}


def colmap(ours: Ours, place: Path, kept: pieces.Kept) -> tuple[Model | None, str]:
    """COLMAP's model of all photographs, at the size of our run; one of the same images that is kept is taken again."""
    frames = {index: frame.image for index, frame in ours.frames.items()}
    intrinsics = next(iter(ours.frames.values())).intrinsics
    return colmap_poses.reconstruct_once(frames, intrinsics, place, 1, kept, photographs=True)


def with_focal(ours: Ours, focal: float) -> Ours:
    """The photographs with COLMAP's own focal length."""
    lens = {i: np.array([focal, focal, *frame.intrinsics[2:]]) for i, frame in ours.frames.items()}
    return replace(ours, frames={i: replace(frame, intrinsics=lens[i]) for i, frame in ours.frames.items()})


def our_rows(scene: str, ours: Ours, known: set[int]) -> list[Row]:
    """known: photographs that count."""
    scores = [s for s in ours.report["rendering"]["frames"] if s["held_out"] and s["index"] in known]
    worst = min(scores, key=lambda score: float(score["psnr"]))
    bare = min(scores, key=lambda score: float(score["coverage"]))
    covered = 100.0 * float(np.mean([score["coverage"] for score in scores]))
    return [
        Row(f"{scene}: photographs with a pose", f"{len(ours.poses)} of {len(ours.frames)}"),
        Row(f"{scene}: held-out PSNR, all", ours.psnr(set(ours.frames)), "dB"),
        Row(f"{scene}: held-out PSNR, those that count", ours.psnr(known), "dB"),
        Row(f"{scene}: worst held-out photograph", worst["psnr"], f"dB ({worst['index']})"),
        at_least(f"{scene}: held-out pixels covered", covered, "%", COVERED),
        Row(f"{scene}: least covered", 100.0 * bare["coverage"], f"% ({bare['index']})"),
        Row(f"{scene}: splats", figure(ours.report, "map.splats")),
        Row(f"{scene}: seconds of optimization", ours.optimization, "s"),
        Row(f"{scene}: seconds, photographs to map", ours.everything, "s"),
    ]


def their_rows(scene: str, ours: Ours, model: Model, best: Trained) -> list[Row]:
    known = set(model.index.tolist())
    return [
        Row(f"{scene}: photographs with a pose, COLMAP", f"{len(known)} of {len(ours.frames)}"),
        Row(f"{scene}: held-out PSNR, COLMAP + splatting", best.psnr, f"dB ({best.way.partition(', ')[2]})"),
        Row(f"{scene}: splats, COLMAP + splatting", best.splats),
        Row(f"{scene}: seconds, photographs to map, COLMAP + splatting", best.seconds + model.processor_seconds, "s"),
        at_least(f"{scene}: ours minus theirs, equal time", ours.psnr(known) - best.psnr, "dB", BEHIND),
    ]


def protocol(scene: str, ours: Ours) -> Row:
    height, width = next(iter(ours.frames.values())).image.shape[:2]
    made = f"{ours.report['map']['iterations']} iterations of ours"
    return Row(f"{scene}: protocol", f"{len(ours.frames)} at {width}x{height}, {len(ours.held_out)} held out, {made}")


def ways(options: argparse.Namespace) -> dict[str, tuple[Any, ...]]:
    return {part: values[:1] for part, values in WAYS.items()} if options.quick else WAYS


def overrides_of(options: argparse.Namespace) -> list[str]:
    return [*GIVEN, *options.overrides, *(QUICK if options.quick else ())]


def compare(scene: str, options: argparse.Namespace, output: Path) -> list[Row]:
    place = output / scene
    made = pieces.Pieces(place, options.resume)
    kept = made.kept()
    ours, _ = run_ours(scene, overrides_of(options), {}, place / "ours", made)
    if ours is None:
        return [failed(f"{scene}: ours", why_not(scene, place / "ours"))]
    model, why = colmap(ours, place / "colmap", kept)
    if model is None:
        rows = [*our_rows(scene, ours, set(ours.frames)), Row(f"{scene}: COLMAP", why)]
    else:
        theirs, file = with_focal(ours, model.focal), place / "colmap" / "model.npz"
        train = offline.kept_in(place / "trained", file, kept, partial(offline.train, model, theirs, threads=1))
        _, tried = offline.best_way(ways(options), train, ours.optimization)
        best = max(tried, key=lambda result: result.psnr)
        rows = [*our_rows(scene, ours, set(model.index.tolist())), *their_rows(scene, ours, model, best)]
    of_parts = [replace(row, name=f"{scene}: {row.name}") for row in made.rows()]
    return [protocol(scene, ours), *rows, *of_parts]


def measure(options: argparse.Namespace) -> list[Row]:
    scenes, skipped = pieces.with_data(options.scenes or (SCENES[:1] if options.quick else SCENES))
    output, asked = folder(options, "photographs"), {"overrides": overrides_of(options), "ways": ways(options)}
    measured = partial(compare, options=options, output=output)
    return pieces.in_pieces(scenes, output, options.resume, options.minutes, measured, asked) + skipped


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"comma separated; default: {','.join(SCENES)}; --quick: {SCENES[0]}"
    parser.add_argument("--scenes", type=names(choices("scene")), help=told)
    parser.add_argument("overrides", nargs="*", help="of our runs: dataset.size=60000")
    pieces.kept_arguments(parser, minutes=True)


if __name__ == "__main__":
    main(measure, "Maps of photographs beside COLMAP with offline splatting", arguments)
