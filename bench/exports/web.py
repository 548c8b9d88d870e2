"""Splat viewers and three.js in a headless Chromium: what people look at exports with."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlparse

import cv2
import numpy as np

from bench import chromium
from bench.exports.made import MESHES, SPLATS, Made, Opened
from bench.pivot import MAX_CELL
from mvsgs_core.export.turning import RUB_FROM_RDF
from mvsgs_core.image_metrics import psnr

PACKAGES = {"spark": "@sparkjsdev/spark", "gs3d": "@mkkellogg/gaussian-splats-3d", "three": "three"}
TURNED = (".spz", ".glb")  # formats whose axes are x right, y up, z back
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera that looks along -z
PAGE = Path(__file__).with_name("page.html")


class _Files(SimpleHTTPRequestHandler):
    """The page, /node_modules/ of the scratch folder and /exports/."""

    def __init__(self, *given: object, node: Path, exports: Path) -> None:
        self._roots = {"node_modules": node / "node_modules", "exports": exports}
        super().__init__(*given)  # type: ignore[arg-type]

    def translate_path(self, path: str) -> str:
        _, root, *rest = unquote(urlparse(path).path).split("/")
        return str(PAGE if root not in self._roots else self._roots[root].joinpath(*rest))

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def _served(node: Path, exports: Path) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Files, node=node, exports=exports))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def in_browser(made: Made, node: Path) -> list[Opened]:
    """Each export in each program that reads its format, a page each."""
    jobs = [(name, "spark") for name in SPLATS] + [(name, "gs3d") for name in SPLATS]
    jobs += [(name, "three") for name in MESHES if not name.endswith(".off")]
    found = []
    with _served(node, made.folder) as address, chromium.browser() as page:
        page.size(made.size[1], made.size[0])
        for name, program in jobs:
            shown = f"{PACKAGES[program].rpartition('/')[2]} {_version(node, PACKAGES[program])}"
            try:
                page.open(f"{address}/{name}.{program}.html")
                page.until("window.ready")
                count = page.evaluate(f"load({json.dumps(program)}, {json.dumps(f'/exports/{name}')})")
                found.append(Opened(name, shown, int(count), _compared(made, page, name)))
            except (RuntimeError, AssertionError) as error:
                found.append(Opened(name, shown, note=_reason(error)))
    return found


def _compared(made: Made, page: chromium.Browser, name: str) -> float | None:
    """dB, mean over the views; of a mesh at the pixels that it covers; None where it has no colors."""
    if name.endswith(".stl"):
        return None
    height, width = made.size
    found = []
    for view in made.views:
        world_from_cam = made.pose(view)
        if name.endswith(TURNED):
            world_from_cam = np.vstack([RUB_FROM_RDF @ world_from_cam[:3], world_from_cam[3:]])
        pose = (world_from_cam @ OPENGL).T.ravel().tolist()
        url = page.evaluate(f"shoot({pose}, {made.intrinsics[0]}, {width}, {height})")
        data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        encoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        assert encoded is not None
        picture = cv2.cvtColor(encoded, cv2.COLOR_BGRA2RGBA).astype(np.float32) / 255.0
        covered = picture[..., 3] > 0.5 if name.startswith("mesh") else None
        if covered is not None and covered.mean() < 0.5:
            raise RuntimeError(f"the picture shows it at {100 * covered.mean():.0f} % of the pixels")
        shown = picture[..., :3] * picture[..., 3:]  # before black, as ours is
        found.append(psnr(shown, made.render(view).astype(np.float32) / 255.0, covered))
    return float(np.mean(found))


def _version(node: Path, package: str) -> str:
    return str(json.loads((node / "node_modules" / package / "package.json").read_text())["version"])


def _reason(error: BaseException) -> str:
    text = str(error)
    said = re.search(r"'(?:description|value)': ['\"](.*?)(?:\\n|['\"]})", text)
    return " ".join((said[1] if said else text).split())[: MAX_CELL - 10]


def missing(node: Path) -> list[str]:
    """Packages that are not there."""
    return [package for package in PACKAGES.values() if not (node / "node_modules" / package).is_dir()]


__all__ = ["PACKAGES", "in_browser", "missing"]
