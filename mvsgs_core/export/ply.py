"""map.ply: the layout of 3D Gaussian Splatting that viewers and trainers read, with the shape as an extra property."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvsgs_core.atomic_file import replacing
from mvsgs_core.bad_file import reading
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.kernels import KERNELS, gaussian_std_ratio, log_scale_shift, neutral_beta
from mvsgs_core.rasterizer.spherical_harmonics import degree_of
from mvsgs_core.rasterizer.splats import Splats

_MAX_HEADER = 2**16  # bytes
CHUNK = 16384  # splats that are written at once: the columns of all would take as much memory as the map
ROUNDED = 0.05  # of the median standard deviation of the splats: positions are not rounded to coarser steps
_SAMPLE = 10_000  # splats that this is measured on


def write_ply(path: Path, final: Snapshot, *, fold: bool = False, sync: bool = False) -> None:
    """Replaces `path` in one step by the map, binary little endian: x y z nx ny nz f_dc_* f_rest_* opacity scale_*
    rot_*, and beta. sync: see `replacing`.

    Positions are world coordinates, the origin added in float64 before the cast; only where float32 would round them
    too coarsely for the splats are they relative to it. A comment `origin x y z` tells what must be added.
    fold: for viewers that know only Gaussians; the scales are those of the closest Gaussian, and there is no beta. The
    scale is a logarithm: what multiplies the standard deviation is added to it. Of an antialiased map a comment
    `antialiased` says so to who knows it; other programs must be told, or show it too bright. A comment `background r g
    b`, 0 to 1, is the color where there is no splat, for who knows it, too.
    """
    origin, kernel = relative_origin(final), "gaussian" if fold else final.kernel

    def columns(chosen: slice) -> dict[str, np.ndarray]:
        splats = Splats(**{name: value[chosen] for name, value in final.splats.tensors().items()})
        return _properties(folded(splats, final.kernel) if fold else splats, final.origin - origin, kernel)

    names, count = list(columns(slice(0, 0))), len(final.splats)
    with replacing(path, sync=sync) as aside, aside.open("wb") as file:
        file.write(_header(final, names, origin, kernel))
        for first in range(0, count, CHUNK):
            some = columns(slice(first, first + CHUNK))
            rows = np.empty(min(CHUNK, count - first), dtype=[(name, "<f4") for name in names])
            for name, values in some.items():
                rows[name] = values
            file.write(rows.data)


def ply_size(final: Snapshot) -> int:
    """Bytes of the file that `write_ply` makes."""
    none = Splats(**{name: value[:0] for name, value in final.splats.tensors().items()})
    names = list(_properties(none, final.origin, final.kernel))
    return len(_header(final, names, relative_origin(final), final.kernel)) + 4 * len(names) * len(final.splats)


def _header(final: Snapshot, names: list[str], origin: np.ndarray, kernel: str) -> bytes:
    lines = [
        "ply", "format binary_little_endian 1.0", f"comment density {kernel}",
        "comment origin " + " ".join(repr(float(value)) for value in origin),
        *(["comment antialiased"] if final.antialiased else []), *_background_line(final),
        f"element vertex {len(final.splats)}", *(f"property float {name}" for name in names), "end_header\n",
    ]  # fmt: skip
    return "\n".join(lines).encode("ascii")


def _properties(splats: Splats, shift: np.ndarray, kernel: str) -> dict[str, np.ndarray]:
    """The columns of the file by name, in its order. shift: (3,) float64, added to the positions."""
    means = splats.means.numpy().astype(np.float64) + shift
    harmonics = splats.sh.numpy()
    # all of red, then green, then blue
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(splats), 3 * (harmonics.shape[1] - 1))
    columns = {"x": means[:, 0], "y": means[:, 1], "z": means[:, 2]}
    columns |= {name: np.zeros(len(splats)) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{k}": harmonics[:, 0, k] for k in range(3)}
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns["opacity"] = splats.opacity_logits.numpy()
    columns |= {f"scale_{k}": splats.log_scales[:, k].numpy() for k in range(3)}
    unit = torch.nn.functional.normalize(splats.quaternions, dim=1).numpy()
    columns |= {f"rot_{k}": unit[:, k] for k in range(4)}
    if kernel != "gaussian":
        columns["beta"] = splats.betas.numpy()
    return columns


def _background_line(final: Snapshot) -> list[str]:
    if final.background is None:
        return []
    return ["comment background " + " ".join(repr(float(value)) for value in final.background)]


def relative_origin(final: Snapshot) -> np.ndarray:
    """(3,) float64 that exported positions are relative to: 0 unless float32 would round world coordinates to steps
    that are coarse beside the splats, and finer ones relative to the origin. Medians: strays do not decide."""
    chosen = slice(None, None, len(final.splats) // _SAMPLE + 1)
    means = final.splats.means[chosen].numpy()
    if not len(means):
        return np.zeros(3)
    deviation = float(np.exp(np.nanmedian(final.splats.log_scales[chosen].numpy())))
    world = _step(means + final.origin)
    return final.origin if world > ROUNDED * deviation and world > _step(means) else np.zeros(3)


def _step(positions: np.ndarray) -> float:
    """Of float32, at the median of positions (N, 3)."""
    return float(np.spacing(np.float32(np.nanmedian(np.abs(positions).max(axis=1)))))


def folded(splats: Splats, kernel: str) -> Splats:
    """The closest plain Gaussians: the shape goes into the scales."""
    if kernel == "gaussian":
        return splats
    shift = log_scale_shift(splats.betas) if kernel == "ges_scale" else gaussian_std_ratio(splats.betas).log()
    return replace(splats, log_scales=splats.log_scales + shift[:, None], betas=torch.full_like(splats.betas, 2.0))


def read_ply(path: Path) -> Snapshot:
    """A map that any 3DGS program wrote, binary little endian; without keyframes, anchors -1.

    Raises BadFileError, saying what is wrong with the file. Values of splats are as they are there, finite or not.
    """
    data = path.read_bytes()
    with reading(path, "is no PLY file of splats that can be read"):
        return _parse(data)


def _parse(data: bytes) -> Snapshot:
    end = data.find(b"end_header\n", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no header of one")
    header = data[:end].decode("ascii", errors="replace").splitlines()
    if "format binary_little_endian 1.0" not in header:
        raise ValueError("only binary_little_endian PLY files are read")
    count, names, origin, kernel, background = _parse_header(header)
    antialiased = "comment antialiased" in header
    available = {name for name, _ in names}
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3)),
              *(f"rot_{k}" for k in range(4))]  # fmt: skip
    dtype = np.dtype([(name, kind) for name, kind in names])
    length = len(data) - end - len(b"end_header\n")
    if length < count * dtype.itemsize:
        raise ValueError(f"it is cut short: {length} bytes of {count * dtype.itemsize}")
    missing = [name for name in needed if name not in available]
    if missing:
        raise ValueError(f"it holds no splats: it lacks {', '.join(missing)}")
    rows = np.frombuffer(data, dtype=dtype, count=count, offset=end + len(b"end_header\n"))
    rest = sorted((name for name in available if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    bases = 1 + len(rest) // 3
    degree_of(bases)
    sh = np.zeros((count, bases, 3), dtype=np.float32)
    sh[:, 0] = _columns(rows, ["f_dc_0", "f_dc_1", "f_dc_2"])
    if rest:
        sh[:, 1:] = _columns(rows, rest).reshape(count, 3, bases - 1).transpose(0, 2, 1)
    if kernel is None:
        kernel = "exact" if "beta" in available else "gaussian"
    betas = rows["beta"] if "beta" in available else np.full(count, neutral_beta(kernel))
    splats = Splats(
        means=_tensor(_columns(rows, ["x", "y", "z"])),
        log_scales=_tensor(_columns(rows, ["scale_0", "scale_1", "scale_2"])),
        quaternions=_tensor(_columns(rows, ["rot_0", "rot_1", "rot_2", "rot_3"])),
        opacity_logits=_tensor(rows["opacity"]),
        sh=_tensor(sh),
        betas=_tensor(betas),
    )
    return Snapshot(
        splats=splats, anchors=np.full(count, -1, dtype=np.int64), origin=origin, kernel=kernel, iterations=0,
        keyframes=np.zeros(0, dtype=np.int64), world_from_cam=np.zeros((0, 4, 4)), scale=np.zeros(0),
        exposures=np.zeros((0, 3, 4), dtype=np.float32), antialiased=antialiased, background=background,
    )  # fmt: skip


def _parse_header(
    header: list[str],
) -> tuple[int, list[tuple[str, str]], np.ndarray, str | None, np.ndarray | None]:
    kinds = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1",
             "int": "<i4", "int32": "<i4"}  # fmt: skip
    count, names, origin, kernel, background = -1, [], np.zeros(3), None, None
    for line in header:
        words = line.split()
        match words:
            case ["element", "vertex", number]:
                count = int(number)
            case ["element", other, _]:
                raise ValueError(f"it has an element {other!r}: expected vertices only")
            case ["property", kind, name] if kind in kinds:
                names.append((name, kinds[kind]))
            case ["property", *_]:
                raise ValueError(f"its property cannot be read, {line!r}")
            case ["comment", "origin", x, y, z]:
                origin = np.array([float(x), float(y), float(z)])
                if not np.all(np.isfinite(origin)):
                    raise ValueError(f"its origin is not finite, {origin}")
            case ["comment", "background", r, g, b]:
                background = np.array([float(r), float(g), float(b)], dtype=np.float32)
                if not np.all(np.isfinite(background)):
                    raise ValueError(f"its background is not finite, {background}")
            case ["comment", "density", name] if name in KERNELS:
                kernel = name
    if count < 0:
        raise ValueError("it has no vertices")
    return count, names, origin, kernel, background


def _columns(rows: np.ndarray, names: list[str]) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=-1)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.require(values, np.float32, ("C", "W")))  # a copy of what is still the file's bytes
