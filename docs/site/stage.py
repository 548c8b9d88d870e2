"""Gathers what the site is made of: `python docs/site/stage.py`, then `mkdocs build --strict`; `make docs` does both.

The documents keep the places that they have in the repository, so that a link leads to the same file in both. Pages of
the reference name what mkdocstrings reads from the sources, without importing them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STAGED = ROOT / "build" / "site" / "source"
SUFFIXES = (".md", ".jpg", ".svg")
ALONE = (
    "README.md",
    "ARCHITECTURE.md",
    "BENCHMARKS.md",
    "CHANGELOG.md",
    "LICENSE",
    "examples/README.md",
    "msgs/WIRE.md",
)

# page -> title, words of its own, and what is described there
REFERENCE: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "program": (
        "Within a program",
        "`from mvsgs_core import Mapping`; the others are names of `mvsgs`.",
        (
            "mvsgs.mapping.Mapping", "mvsgs.mapping.Tracked", "mvsgs.mapping.PosedKeyframe",
            "mvsgs.gaussian_map.GaussianMap", "mvsgs.gaussian_map.View", "mvsgs_core.trajectory.Trajectory",
        ),
    ),
    "nodes": ("Nodes and messages", "What a node is, and what nodes send each other.", ("nodes", "msgs")),
    "parameters": (
        "Parameters",
        "Of the weight-free stages, by slot; `mvsgs parameters` lists those of any choice.",
        (
            "mvsgs_core.datasets.options.FileOptions", "mvsgs_core.tracking.config.TrackerConfig",
            "mvsgs_core.mvs.cascade.CascadeConfig", "mvsgs_core.fusion.fusion.FusionConfig",
            "mvsgs_core.mapping.config.MapperConfig", "mvsgs_core.mapping.config.TrainingConfig",
        ),
    ),
    "core": (
        "The core",
        "Arrays in, arrays out: what can be used by itself.",
        (
            "mvsgs_core.datasets", "mvsgs_core.tracking.tracker.Tracker", "mvsgs_core.mvs.cascade.Cascade",
            "mvsgs_core.fusion.fusion.OnlineFusion", "mvsgs_core.mapping.mapper.OnlineMapper",
            "mvsgs_core.mapping.losses", "mvsgs_core.rasterizer.rasterize", "mvsgs_core.export.snapshot.Snapshot",
            "mvsgs_core.export.cameras", "mvsgs_core.camera", "mvsgs_core.geometry",
        ),
    ),
}  # fmt: skip


def stage(root: Path = ROOT, staged: Path = STAGED) -> list[Path]:
    """Makes the folder anew; the pages in it."""
    shutil.rmtree(staged, ignore_errors=True)
    named = [root / name for name in ALONE]
    for file in [*named, *(path for path in (root / "docs").rglob("*") if path.suffix in SUFFIXES)]:
        copy = staged / file.relative_to(root)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    (staged / "reference").mkdir()
    for page, (title, words, described) in REFERENCE.items():
        inherited = "\n    options: {inherited_members: true}" if page == "parameters" else ""
        blocks = "\n\n".join(f"::: {name}{inherited}" for name in described)
        (staged / "reference" / f"{page}.md").write_text(f"# {title}\n\n{words}\n\n{blocks}\n")
    return sorted(staged.rglob("*.md"))


if __name__ == "__main__":
    stage()
