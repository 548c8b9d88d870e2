"""Other ways to the same result on the same frames, beside ours.

Poses: COLMAP (pycolmap) with sequential matching, calibration given, on our keyframes, every 5th frame and a hundred
evenly, at up to 512x384 pixels: more than our tracker looks at. Map: an offline 3D Gaussian splatting of COLMAP's
sparse points with COLMAP's poses, by our own rasterizer and optimizer, at the size of our run, scored on our held-out
frames (every 5th that is no keyframe). It is trained in as many processor seconds as our mapper takes, in the way that
is its best: on our keyframes or on every frame that is not held out, with and without an exposure a frame, settling
early or late, one choice after the other; then twice as long and so on, until doubling the time gains less than 0.1 dB.
 Both have one thread. --opensplat PATH: OpenSplat on its CPU path, too.
All times are of the processor. What ended is kept for --resume, but for OpenSplat's maps.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench import pieces
from bench.baselines import offline, opensplat
from bench.baselines.colmap_poses import Model
from bench.baselines.offline import GAIN, Trained, converged
from bench.baselines.ours import Ours, ate_percent, cheapest, run_ours, why_not
from bench.finished import read_frames
from bench.runs import FEWER, QUICK, Run, choices, fewer_iterations, figure, folder
from bench.table import Row, at_least, at_most, checked, failed, main, names
from bench.tracking.baselines import Baseline, solve
from mvsgs_core.datasets import Item
from mvsgs_core.held_out import is_held_out
from mvsgs_core.machine import available_cores

SCENES = ["redkitchen", "tum_fr1_xyz"]
QUICK_SCENE = "room"  # scene of a quick run: in 30 frames of the real ones COLMAP puts no two images together
EVENLY = 100  # frames that COLMAP gets, about, besides our keyframes and every 5th
AHEAD = 0.5  # dB that ours is to be better than the best of theirs, at equal processor time
SHARE = 0.1  # of their whole time, in which ours is to be as good
THREADS = 1  # of both optimizations


def solve_poses(ours: Ours, place: Path, threads: int, kept: pieces.Kept) -> tuple[Baseline, list[int]]:
    """COLMAP's model, from the images as they come, and the frames that it got. Raises pieces.NotKept."""
    stride = max(1, round(len(ours.frames) / EVENLY))
    known = {*ours.keyframes, *(i for i in ours.frames if is_held_out(i) or i % stride == 0)}
    place.mkdir(parents=True, exist_ok=True)
    whole = read_frames({**ours.settings, "size": None})
    items = [Item(i, whole[i].timestamp, whole[i].image, whole[i].intrinsics) for i in sorted(known)]
    return solve(items, place, threads, kept), sorted(known)


def pose_rows(scene: str, ours: Ours, model: Model, frames: list[int]) -> list[Row]:
    theirs = dict(zip(model.index.tolist(), model.world_from_cam))
    common = [i for i in frames if i in theirs]
    rows = []
    for name, poses in (("ours", ours.poses), ("COLMAP", theirs)):
        posed = sum(i in poses for i in frames)
        rows.append(Row(f"{scene}: poses, {name}: frames posed", f"{posed} of {len(frames)}"))
        rows.append(Row(f"{scene}: poses, {name}: ATE, frames that COLMAP has", ate_percent(poses, ours, common), "%"))
    rows.insert(2, Row(f"{scene}: poses, ours: seconds", figure(ours.report, "time.cpu.tracker"), "s"))
    rows.append(Row(f"{scene}: poses, COLMAP: seconds", model.processor_seconds, "s"))
    rows.append(Row(f"{scene}: poses, COLMAP: sparse points", len(model.points)))
    return rows


def our_rows(scene: str, ours: Ours, model: Model) -> list[Row]:
    known = set(model.index.tolist())
    return [
        Row(f"{scene}: map, ours: held-out PSNR", ours.psnr(known), "dB"),
        Row(f"{scene}: map, ours: held-out SSIM", figure(ours.report, "rendering.held_out.ssim")),
        Row(f"{scene}: map, ours: seconds of optimization", ours.optimization, "s"),
        Row(f"{scene}: map, ours: seconds, frames to map", ours.everything, "s"),
        Row(f"{scene}: map, ours: splats", figure(ours.report, "map.splats")),
        Row(f"{scene}: map, ours: iterations", figure(ours.report, "map.iterations")),
    ]


def trained_rows(name: str, result: Trained, model: Model) -> list[Row]:
    return [
        Row(f"{name}: held-out PSNR", result.psnr, "dB"),
        Row(f"{name}: held-out SSIM", result.ssim),
        Row(f"{name}: seconds of optimization", result.seconds, "s"),
        Row(f"{name}: seconds, frames to map", result.seconds + model.processor_seconds, "s"),
        Row(f"{name}: splats", result.splats),
        Row(f"{name}: iterations", result.iterations),
    ]


def longer_rows(scene: str, model: Model, trained: list[Trained]) -> list[Row]:
    rows = []
    for doublings, (before, result) in enumerate(zip([None, *trained], trained)):
        name = f"{scene}: map, COLMAP + splatting, " + (f"{2**doublings} times as long" if doublings else "equal time")
        rows += trained_rows(name, result, model)
        if before is not None:
            rows.append(Row(f"{name}: gain by twice the time", result.psnr - before.psnr, "dB"))
    if len(trained) > 1:
        gain = trained[-1].psnr - trained[-2].psnr
        name = f"{scene}: COLMAP + splatting, gain by the last doubling of its time"
        rows.append(Row(name, gain, "dB", f"< {GAIN:g}: converged", converged(trained)))
    return rows


def verdict(scene: str, ours: Ours, fewer: dict[str, Run], model: Model, equal: Trained) -> list[Row]:
    """Ours against the best of theirs at equal processor time, and the time to their quality."""
    whole, known = equal.seconds + model.processor_seconds, set(model.index.tolist())
    rows = [
        Row(f"{scene}: COLMAP + splatting, its best way", equal.way),
        at_least(f"{scene}: ours minus theirs, equal time", ours.psnr(known) - equal.psnr, "dB", AHEAD),
    ]
    name = f"{scene}: time from frames to their PSNR, ours over theirs"
    found = cheapest(ours, fewer, equal.psnr, known)
    if found is None:
        return [*rows, Row(name, "none of ours is as good", "", f"<= {SHARE:g}", False)]
    return [*rows, at_most(name, found[1] / whole, f"(by {found[0]})", SHARE)]


def protocol(scene: str, ours: Ours, baseline: Baseline, frames: list[int]) -> Row:
    """What both had, as a row."""
    height, width = next(iter(ours.frames.values())).image.shape[:2]
    text = (
        f"{len(ours.frames)} frames at {width}x{height}, {len(ours.keyframes)} of them keyframes of ours, scored on "
        f"{len(ours.scored)} held-out frames; COLMAP got {len(frames)} of the frames at "
        f"{baseline.size[1]}x{baseline.size[0]}"
    )
    return Row(f"{scene}: protocol", text)


def compare(scene: str, options: argparse.Namespace, overrides: list[str], made: pieces.Pieces) -> Iterator[list[Row]]:
    """The rows of a scene, part by part. Raises pieces.NotKept at the first that is not there and may not begin."""
    place, kept = made.output / scene, made.kept()
    ours, fewer = run_ours(scene, overrides, options.fewer, place / "ours", made)
    if ours is None:
        there = not any(name.startswith(f"{scene}/") for name in made.missing)
        yield [failed(f"{scene}: ours", why_not(scene, place / "ours"))] if there else []
        return
    baseline, frames = solve_poses(ours, place / "colmap", options.threads or available_cores(), kept)
    yield [protocol(scene, ours, baseline, frames)]
    model = baseline.model
    if model is None:
        yield [Row(f"{scene}: COLMAP", baseline.why)]
        return
    yield [*pose_rows(scene, ours, model, frames), *our_rows(scene, ours, model)]
    train_anew = partial(offline.train, model, ours, threads=THREADS)
    train = offline.kept_in(place / "trained", place / "colmap" / "model.npz", kept, train_anew)
    try:
        parts = {} if options.quick else offline.choices(ours)
        best, tried = offline.best_way(parts, train, ours.optimization)
        trained = offline.train_longer(best, train, ours.optimization, options.longest)
    except ValueError as error:
        yield [Row(f"{scene}: map, COLMAP + splatting", str(error))]
        return
    yield longer_rows(scene, model, trained)
    yield [Row(f"{scene}: equal time, {result.way}: held-out PSNR", result.psnr, "dB") for result in tried]
    yield verdict(scene, ours, fewer, model, trained[0])
    if options.opensplat is not None and not made.may_start():
        raise pieces.NotKept(place / "opensplat")
    yield opensplat_rows(scene, options.opensplat, ours, model, place / "opensplat")


def opensplat_rows(scene: str, binary: Path | None, ours: Ours, model: Model, place: Path) -> list[Row]:
    """None where no binary is given."""
    if binary is None:
        return []
    try:
        results = opensplat.train(binary.resolve(), ours, model, place, THREADS)
    except (RuntimeError, OSError) as error:
        return [Row(f"{scene}: OpenSplat", str(error), "", "a map", False)]
    rows = []
    for times, result in zip((1, *opensplat.MANY_TIMES), results):
        which = "equal time" if times == 1 else f"{times} times the iterations"
        rows += trained_rows(f"{scene}: map, COLMAP + OpenSplat, {which}", result, model)
    ahead = ours.psnr(set(model.index.tolist())) - results[0].psnr
    return [*rows, at_least(f"{scene}: ours minus OpenSplat, equal time", ahead, "dB", AHEAD)]


def measure(options: argparse.Namespace) -> list[Row]:
    scenes, skipped = pieces.with_data(options.scenes)
    overrides = list(options.overrides)
    if options.quick:
        scenes, skipped, options.longest = [QUICK_SCENE], [], 1.0
        overrides += QUICK
    made = pieces.Pieces.of(options, folder(options, "baselines"))
    rows: list[Row] = []
    for scene in scenes:
        try:
            for part in compare(scene, options, overrides, made):
                rows += part
        except pieces.NotKept as missing:
            made.missing.append(str(missing.file.relative_to(made.output)))
    return rows + skipped + made.rows()


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"comma separated; default: {','.join(SCENES)}; --quick: {QUICK_SCENE}"
    parser.add_argument("--scenes", type=names(choices("scene")), default=SCENES, help=told)
    parser.add_argument("--longest", type=float, default=8.0, help="times our mapper's time, for the offline one")
    parser.add_argument("--threads", type=int, help="of COLMAP; default: all cores")
    parser.add_argument("--fewer", type=checked(fewer_iterations), default={}, help=FEWER)
    parser.add_argument("--opensplat", type=Path, help="binary of OpenSplat, to be run too")
    pieces.arguments(parser, "dataset.stop=100")


if __name__ == "__main__":
    main(measure, "Baselines on the same frames", arguments)
