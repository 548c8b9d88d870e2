"""A binary glTF 2.0 file (.glb) of a mesh with colors at its vertices, which needs no light to show them."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.export.turning import RUB_FROM_RDF

_FLOAT, _UINT = 5126, 5125  # component types of glTF
_VERTICES, _INDICES = 34962, 34963  # targets of its buffer views


def write_glb(path: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray, origin: np.ndarray) -> None:
    """Vertices (V, 3) relative to `origin` (3,), triangles (T, 3) of their indices, colors (V, 3) sRGB in [0, 1].

    glTF's axes are x right, y up, z back: ours are turned by 180 degrees about x. Its vertex colors are linear. The
    colors are what the cameras saw, light and shadow in them: the material is unlit, and for programs that do not know
    that extension no metal. The origin stands in the node's translation, so that float32 holds the vertices. Raises
    ValueError for a mesh without triangles.
    """
    if not len(triangles):
        raise ValueError("the mesh has no triangles")
    positions = (vertices @ RUB_FROM_RDF.T).astype("<f4")
    chunks = [positions, linear(colors).astype("<f4"), triangles.astype("<u4").reshape(-1)]
    offsets = np.cumsum([0, *(chunk.nbytes for chunk in chunks)])
    views = [
        {"buffer": 0, "byteOffset": int(offset), "byteLength": chunk.nbytes, "target": target}
        for offset, chunk, target in zip(offsets, chunks, (_VERTICES, _VERTICES, _INDICES))
    ]
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors = [
        {"bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3", **bounds},
        {"bufferView": 1, "componentType": _FLOAT, "count": len(positions), "type": "VEC3"},
        {"bufferView": 2, "componentType": _UINT, "count": triangles.size, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {"KHR_materials_unlit": {}},
        "doubleSided": True,
    }
    node: dict[str, Any] = {"mesh": 0}
    if origin.any():
        node["translation"] = (RUB_FROM_RDF @ origin).tolist()
    content = {
        "asset": {"version": "2.0", "generator": "MVS-GS"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": int(offsets[-1])}],
    }
    text = json.dumps(content, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(chunk.tobytes() for chunk in chunks)  # four bytes a number: aligned as it is
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(body), b"BIN\0") + body)


def linear(colors: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, both in [0, 1] (IEC 61966-2-1)."""
    colors = np.clip(colors, 0.0, 1.0)
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
