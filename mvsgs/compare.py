"""`mvsgs compare RUN RUN...`: runs side by side, their figures and, with --html, renders of the same keyframes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from launch.comparison import compared, comparison_text, names
from mvsgs_core.atomic_file import replace_text
from mvsgs_core.datasets.files import read_image
from mvsgs_core.evaluation import html
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras, read_cameras
from mvsgs_core.export.command_line import run
from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.export.ply import read_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.preview import as_bytes

SHOWN = 3  # keyframes that all runs have


def page(outputs: Sequence[Path]) -> str:
    """The comparison as one self-contained HTML file. Raises ValueError and OSError."""
    heading, *rows = compared(outputs)
    table = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    head = "".join(f"<th>{escape(cell)}</th>" for cell in heading)
    body = [f"<h1>{len(outputs)} runs side by side</h1>", f"<table><tr>{head}</tr>{table}</table>"]
    maps = [(read_ply(output / "map.ply"), read_cameras(output / "cameras.json")) for output in outputs]
    for index in common_keyframes([cameras for _, cameras in maps]):
        pictures = {name: render(final, cameras, index) for name, (final, cameras) in zip(names(outputs), maps)}
        photograph = outputs[0] / keyframe_images.FOLDER / keyframe_images.image_name(index)
        if photograph.is_file():
            pictures = {"photograph": read_image(photograph), **pictures}
        body.append(html.row(f"keyframe {index}", pictures))
    return html.document(f"Comparison of {', '.join(names(outputs))}", body)


def common_keyframes(cameras: Sequence[Cameras]) -> list[int]:
    """Some that all runs have, spread over the stream."""
    common = sorted(set.intersection(*(set(each.keyframes.tolist()) for each in cameras)))
    places = np.linspace(0, len(common) - 1, min(SHOWN, len(common))).round().astype(int)
    return [common[place] for place in places.tolist()]


def render(final: Snapshot, cameras: Cameras, index: int) -> np.ndarray:
    """(H, W, 3) uint8 of a keyframe, in its photograph's exposure."""
    k = cameras.keyframes.tolist().index(index)
    return as_bytes(rendered_keyframe(final, cameras, k)[0])


def compare(options: argparse.Namespace) -> str:
    """Does what the command line asks. Raises ValueError and OSError."""
    outputs = [path.parent if path.is_file() else path for path in options.runs]
    if len(outputs) < 2:
        raise ValueError("give two runs or more: their output folders")
    if len({output.resolve() for output in outputs}) < len(outputs):
        raise ValueError("a run is given twice")
    text = comparison_text(outputs)
    if options.html is not None:
        replace_text(options.html, page(outputs))
        text += f"\n{options.html}: the same with pictures"
    return text


def main(arguments: list[str] | None = None, prog: str = "mvsgs compare") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="output folders of runs")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page, with renders of the same keyframes")
    return run(parser, arguments, compare)
