"""Every export in programs that are not ours: `python -m bench.exports --node FOLDER`.

A map of the synthetic room is exported to all formats. Each is opened by what people open it with: how many splats,
triangles, cameras or frames were read, and where the program renders, PSNR against our own render of the map from the
same camera. Programs of Node.js and a nerfstudio are used where they are installed, in folders of their own:

    mkdir FOLDER && cd FOLDER
    npm install @playcanvas/splat-transform @sparkjsdev/spark @mkkellogg/gaussian-splats-3d three
    python -m venv VENV && VENV/bin/pip install nerfstudio   # --nerfstudio VENV/bin/python
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from bench import chromium
from bench.exports.made import MESHES, SPLATS, Opened, make
from bench.exports.programs import by_programs
from bench.exports.web import in_browser, missing
from bench.table import Row, main

CONVERTER = "@playcanvas/splat-transform"
# dB that a render of an export reaches in each program; of meshes none: they are another kind of map
GOALS = dict.fromkeys(SPLATS, 35.0) | {"flight.mp4": 30.0}


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--node", type=Path, help="folder in which npm installed the viewers; without: none of them")
    parser.add_argument("--nerfstudio", type=Path, help="a Python that has nerfstudio; without: it is left out")
    parser.add_argument("--keep", type=Path, help="folder for the exports; without: they are removed")


def measure(options: argparse.Namespace) -> list[Row]:
    node, absent = _node(options.node)
    if options.nerfstudio is None:
        absent.append("nerfstudio (a virtual environment of its own: pip install nerfstudio; --nerfstudio its python)")
    with tempfile.TemporaryDirectory(prefix="mvsgs-") as scratch:
        folder = (options.keep or Path(scratch)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        made = make(folder, options.quick)
        found = by_programs(made, node, options.nerfstudio)
        if node is not None and _has_browser(absent):
            found += in_browser(made, node)
    rows = []
    for one in sorted(found, key=_place):
        goal = None if options.quick else GOALS.get(one.export)
        rows += one.rows(made.counts.get(one.export, made.counts["mesh"]), goal)
    return rows + ([Row("left out, as it is not installed", "; ".join(absent))] if absent else [])


def _node(folder: Path | None) -> tuple[Path | None, list[str]]:
    """The folder of npm where all is there, and what is not."""
    install = f"npm install {CONVERTER} @sparkjsdev/spark @mkkellogg/gaussian-splats-3d three"
    if folder is None or shutil.which("node") is None:
        return None, [f"programs of Node.js (in a folder of their own: {install}; --node that folder)"]
    folder = folder.absolute()
    lacking = missing(folder) + ([] if (folder / "node_modules" / CONVERTER).is_dir() else [CONVERTER])
    return (None if lacking else folder), [f"{name} (in {folder}: npm install {name})" for name in lacking]


def _has_browser(absent: list[str]) -> bool:
    try:
        chromium.executable()
    except FileNotFoundError as error:
        absent.append(f"{error} (sudo apt install chromium)")
        return False
    return True


def _place(opened: Opened) -> int:
    order = [*SPLATS, *MESHES, "colmap", "transforms.json", "flight.mp4"]
    return order.index(opened.export)


if __name__ == "__main__":
    main(measure, "Exports in other programs", arguments)
