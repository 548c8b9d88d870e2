"""Depth: inliers, completeness and time of stereo and fusion; `python -m bench.depth [--quick] [--only SECTIONS]`.

Inliers: kept pixels within 2 % (synthetic) or 5 % (real) of the true depth. Completeness: kept part of the pixels with
true depth. Kinect depth is a noisy sensor's, without values at edges and on shiny or far surfaces: these pixels are not
scored; nor are those of icl_nuim's files that are wrong along edges (30 % off their surroundings) and in the far.
"tracked": poses, scale and range are the tracker's, and each map is scaled by its median ratio to the truth. With true
poses the range comes from coarse depth made from the truth with holes, noise and outliers (data.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path

from bench.depth.baselines import baseline_rows
from bench.depth.calibration import calibration_rows
from bench.depth.curves import curve_rows
from bench.depth.data import SOURCES, Scene, load_scene
from bench.depth.failures import failure_rows
from bench.depth.kernel import kernel_rows
from bench.depth.oracle import oracle_rows
from bench.depth.parts import Variant, part_variants, skip_variants, variant_rows
from bench.depth.photos import PHOTOS, photo_rows
from bench.depth.pose_refinement import refine_poses
from bench.depth.run import Run, run, score, surest
from bench.depth.sensor import sensor_offset, without_offset
from bench.depth.streets import street_rows
from bench.depth.tracked import load_tracked
from bench.runs import DATA, folder
from bench.table import Row, at_least, at_most, main, names, skipped
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig

GOALS = {"room": (0.97, 0.75), "redkitchen": (0.90, 0.55), "fr1_xyz": (0.90, 0.55)}  # inliers, completeness
SMALL, LARGE = 320 * 240, 512 * 384
TRACKED = ("redkitchen", "fr1_xyz", "room")
QUICK = 7  # keyframes


@lru_cache(maxsize=4)
def measured(name: str, area: int, count: int | None, tracked: bool) -> tuple[Scene, Run]:
    """A scene and what the default makes of it."""
    scene = load_tracked(name, area) if tracked else load_scene(name, area, count)
    return scene, run(scene.views, CascadeConfig(area=area), FusionConfig())


def available(wanted: tuple[str, ...]) -> list[str]:
    return [name for name in wanted if not SOURCES[name].folder or (DATA / SOURCES[name].folder).exists()]


def quality_section(options: argparse.Namespace, area: int, tracked: bool) -> list[Row]:
    """Unfiltered and filtered depth, and how well the confidences hold."""
    wanted = TRACKED if tracked else tuple(SOURCES)
    if options.quick:
        wanted = () if tracked or area == LARGE else ("room",)
    there = available(wanted)
    rows = [skipped(name, DATA / SOURCES[name].folder) for name in wanted if name not in there]
    for name in there:
        scene, found = measured(name, area, QUICK if options.quick else None, tracked)
        rows += quality_rows(scene, found, tracked)
    return rows


def quality_rows(scene: Scene, found: Run, align: bool) -> list[Row]:
    raw = score([d.result.depth for d in found.stereo], scene, align)
    kept = score([f.depth for f in found.fused], scene, align)
    height, width = scene.views[0].size
    title = f"{scene.name}, {width}x{height}"
    rows = [
        Row(f"{title}: keyframes", float(len(scene.views))),
        Row(f"{title}: unfiltered inliers", raw.inliers),
        Row(f"{title}: unfiltered relative error", raw.relative_error),
        Row(f"{title}: inliers", kept.inliers),
        Row(f"{title}: completeness", kept.completeness),
        Row(f"{title}: relative error", kept.relative_error),
    ]
    if scene.name in GOALS:
        inliers, completeness = GOALS[scene.name]
        rows[3] = at_least(rows[3].name, kept.inliers, "", inliers)
        rows[4] = at_least(rows[4].name, kept.completeness, "", completeness)
        if kept.completeness >= completeness:
            best = score(surest(found, scene, completeness), scene, align)
            rows.append(at_least(f"{title}: inliers of the surest {completeness:.0%}", best.inliers, "", inliers))
    if scene.name == "redkitchen":
        rows[2] = at_most(rows[2].name, raw.relative_error, "", 0.10)
    return rows


def sensor_section(options: argparse.Namespace) -> list[Row]:
    """Real sensors' maps against each other, with the tracker's poses; kept depth without an offset that they show."""
    rows = []
    for name in [] if options.quick else available(("redkitchen", "fr1_xyz")):
        scene, found = measured(name, SMALL, None, True)
        sensor = sensor_offset(scene)
        title = f"{scene.name}, sensor"
        rows += [
            Row(f"{title}: maps differ by", sensor.before),
            Row(f"{title}: maps differ with an offset by", sensor.after),
            Row(f"{title}: offset of its inverse depth", sensor.offset if sensor.believed else "not believed", "1/m"),
        ]
        if sensor.believed:
            kept = score([f.depth for f in found.fused], without_offset(scene, sensor.offset), align=True)
            rows.append(Row(f"{title}: inliers with it taken out", kept.inliers))
    return rows


def pose_refinement_section(options: argparse.Namespace) -> list[Row]:
    """With dataset poses that were made to fit the images; "aligned": each map scaled by its median ratio to the truth.

    Aligned, because positions that are a few millimeters off leave the scale of single maps some percent off.
    """
    rows = []
    for name in [] if options.quick else available(("redkitchen", "fr1_xyz")):
        scene, before, after = refine_poses(load_scene(name, SMALL))
        found = run(scene.views, CascadeConfig(area=SMALL), FusionConfig())
        kept = [f.depth for f in found.fused]
        as_they_are, aligned = score(kept, scene), score(kept, scene, align=True)
        rows += [
            Row(f"{name}, refined poses: residual of matches before", before, "px"),
            Row(f"{name}, refined poses: residual of matches", after, "px"),
            Row(f"{name}, refined poses: inliers", as_they_are.inliers),
            Row(f"{name}, refined poses: inliers, aligned", aligned.inliers),
            Row(f"{name}, refined poses: completeness", as_they_are.completeness),
        ]
    return rows


def oracle_section(options: argparse.Namespace) -> list[Row]:
    """What a stereo without fault could reach with the dataset's poses, and with the tracker's."""
    rows = oracle_rows(load_scene("room", SMALL, QUICK if options.quick else None), SMALL, tracked=False)
    for name in [] if options.quick else available(("redkitchen", "fr1_xyz")):
        rows += oracle_rows(load_scene(name, SMALL), SMALL, tracked=False)
        rows += oracle_rows(load_tracked(name, SMALL), SMALL, tracked=True)
    return rows


def calibration_section(options: argparse.Namespace) -> list[Row]:
    rows = []
    for name in ("room",) if options.quick else available(("room", "room_b", "aerial", "replica", "icl_nuim")):
        rows += calibration_rows(*measured(name, SMALL, QUICK if options.quick else None, False), align=False)
    for name in [] if options.quick else available(TRACKED[:2]):
        rows += calibration_rows(*measured(name, SMALL, None, True), align=True)
    return rows


def baselines_section(options: argparse.Namespace) -> list[Row]:
    rows = []
    for name in available(("room",) if options.quick else ("room", "redkitchen")):
        rows += baseline_rows(*measured(name, SMALL, QUICK if options.quick else None, False), align=False)
    if not options.quick and available(("redkitchen",)):
        rows += baseline_rows(*measured("redkitchen", SMALL, None, True), align=True)
    return rows


def variants_section(options: argparse.Namespace, title: str, variants: Mapping[str, Variant]) -> list[Row]:
    if options.quick:
        variants = dict(list(variants.items())[:1])
    default = CascadeConfig(area=SMALL), FusionConfig()
    room = load_scene("room", SMALL, QUICK if options.quick else None)
    rows = variant_rows(title, room, default, variants, align=False)
    if not options.quick and available(("redkitchen",)):
        rows += variant_rows(title, load_tracked("redkitchen", SMALL), default, variants, align=True)
    return rows


def curves_section(options: argparse.Namespace) -> list[Row]:
    output = folder(options, "depth")
    count = QUICK if options.quick else None
    rows = curve_rows(lambda area, scales: load_scene("room", area, count, scales), SMALL, False, options.quick, output)
    if not options.quick and available(("redkitchen",)):
        load = partial(load_tracked, "redkitchen")
        rows += curve_rows(load, SMALL, True, False, output)
    return rows


def photos_section(options: argparse.Namespace) -> list[Row]:
    return [] if options.quick else photo_rows(SMALL, list(PHOTOS))


def time_section(options: argparse.Namespace) -> list[Row]:
    """Median time of a keyframe, with all threads that OpenMP has."""
    rows = []
    limits = {SMALL: (350, 80)} if options.quick else {SMALL: (350, 80), LARGE: (900, 200)}
    for area, (stereo_limit, fusion_limit) in limits.items():
        scene = load_scene("room", area, QUICK if options.quick else 10)
        found = run(scene.views, CascadeConfig(area=area), FusionConfig())
        height, width = scene.views[0].size
        rows.append(at_most(f"stereo at {width}x{height}: median", 1000 * found.stereo_seconds, "ms", stereo_limit))
        rows.append(at_most(f"fusion at {width}x{height}: median", 1000 * found.fusion_seconds, "ms", fusion_limit))
        rows.append(Row(f"both at {width}x{height}: processor", 1000 * found.processor_seconds, "ms"))
    return rows


SECTIONS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "quality": partial(quality_section, area=SMALL, tracked=False),
    "tracked": partial(quality_section, area=SMALL, tracked=True),
    "sensor": sensor_section,
    "oracle": oracle_section,
    "pose_refinement": pose_refinement_section,
    "large": partial(quality_section, area=LARGE, tracked=False),
    "large_tracked": partial(quality_section, area=LARGE, tracked=True),
    "calibration": calibration_section,
    "baselines": baselines_section,
    "photos": photos_section,
    "streets": lambda options: [] if options.quick else street_rows(SMALL),
    "parts": partial(variants_section, title="parts", variants=part_variants(SMALL)),
    "skips": partial(variants_section, title="skips", variants=skip_variants(SMALL)),
    "curves": curves_section,
    "failures": lambda options: failure_rows(SMALL, QUICK if options.quick else None),
    "time": time_section,
    "kernel": lambda options: kernel_rows(options.quick),
}


def measure(options: argparse.Namespace) -> list[Row]:
    return [row for name in options.only for row in SECTIONS[name](options)]


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"comma separated; default all: {','.join(SECTIONS)}"
    parser.add_argument("--only", type=names(SECTIONS), default=list(SECTIONS), help=told)
    parser.add_argument("--output", type=Path, help="folder of the plots; default: in runs")


if __name__ == "__main__":
    main(measure, "Depth: multi-view stereo and fusion", arguments)
