"""Fits and checks what IterMVS's confidence means: `python -m bench.learned.calibration`.

Prints the offset and slope for mvsgs_core/mvs/learned.py, by logistic regression of "within 5 % of the truth" on the
logit of the network's confidence, and how well they hold, also on a sequence that took no part.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
import torch

from bench.depth.calibration import INLIER, fit, load, print_reliability
from bench.depth.data import SOURCES
from bench.learned.__main__ import AREA, photographs
from bench.runs import environment
from mvsgs_core.mvs.cascade import CascadeDepth
from mvsgs_core.mvs.learned import NETWORKS, LearnedStereo, LearnedStereoConfig, logit

FIT = ("room", "replica", "fr1_xyz tracked")
CHECK = ("redkitchen tracked",)
SAMPLES = 8000  # pixels of each sequence


def samples(name: str, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """The network's own confidence (N,) and inlier labels (N,) of pixels with true depth."""
    scene = load(name, AREA)
    source = SOURCES[name.partition(" ")[0]]
    images = photographs(scene, source) if source.folder else [item.image for item in scene.items]
    stereo = LearnedStereo(LearnedStereoConfig(area=AREA, threads=1), calibrate=False)
    found: list[CascadeDepth] = []
    for view, image in list(zip(scene.views, images))[:keyframes]:
        stereo.remember(view.index, image)
        found += stereo.add(view)
    found += stereo.flush()
    confidence, inlier = [], []
    for one, truth in zip(found, scene.truths):
        if truth is None or not one.neighbors:
            continue
        depth = one.result.depth
        use = (truth > 0) & (depth > 0)
        factor = np.median(truth[use] / depth[use]) if name.endswith("tracked") else 1.0
        confidence.append(one.result.confidence[use])
        inlier.append(np.abs(depth[use] * factor - truth[use]) < INLIER * truth[use])
    chosen = np.random.default_rng(0).choice(sum(map(len, inlier)), SAMPLES)
    return np.concatenate(confidence)[chosen], np.concatenate(inlier)[chosen]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=24, help="of each sequence at most")
    options = parser.parse_args()
    torch.set_num_threads(1)
    os.environ.update(environment())
    data = {name: samples(name, options.keyframes) for name in (*FIT, *CHECK)}
    now = fit([(np.stack([np.ones(SAMPLES), logit(data[name][0])], axis=1), data[name][1]) for name in FIT])
    print(f"itermvs: ({now[0]:.2f}, {now[1]:.2f})")
    in_code = NETWORKS["itermvs"].calibration
    assert in_code is not None
    for name, (confidence, inlier) in data.items():
        for tag, (offset, slope) in (("fitted now", now), ("in the code", in_code), ("as it comes", (0.0, 1.0))):
            probability = 1 / (1 + np.exp(-offset - slope * logit(confidence)))
            print_reliability(name, tag, probability, inlier)


if __name__ == "__main__":
    main()
