"""Every Triton kernel compiles for three generations of GPUs, which needs none of them; the interpreter is laxer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("triton", reason="triton is not installed: pip install triton to compile for GPUs")

SCRIPT = """
import sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from mvsgs_core.rasterizer.triton import blend, lists, projection, projection_backward, ssim

INTEGERS = {"count", "width", "height", "length", "tiles_x", "tiles"}
FLOATS = {
    "fx", "fy", "cx", "cy", "by_x", "by_y", "by_z", "about_x", "about_y", "about_z", "near",
    "red_behind", "green_behind", "blue_behind", "l1_weight", "l1_scale", "ssim_scale",
}
POINTERS = {
    "camera": "*fp64", "on_pose": "*fp64", "order": "*i64", "pairs": "*i32", "slots": "*i32",
    "refused": "*i32", "pair_tiles": "*i32", "pair_splats": "*i32", "pair_slots": "*i32", "tile_begin": "*i32",
}

def compile_for(capability, function, warps, **constants):
    names = function.arg_names
    kinds = {n: "i32" if n in INTEGERS else "fp32" if n in FLOATS else POINTERS.get(n, "*fp32") for n in names}
    kinds.update(dict.fromkeys(constants, "constexpr"))
    source = ASTSource(function, kinds, {(names.index(n),): value for n, value in constants.items()})
    options = {"num_warps": warps, "enable_fp_fusion": True}
    compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    print(capability, function.__name__, len(compiled.asm["cubin"]))

def compile_all(capability, bases, switches):
    tiles = {"EXACT": switches, "ROW": projection.ROW}
    splats = {**tiles, "BASES": bases, "USED": bases, "ANTIALIASED": switches, "ROLLING": switches, "BLOCK": 64}
    sums, footprint = blend.SUMS, projection.FOOTPRINT
    compile_for(capability, projection.project, 2, FOOTPRINT=footprint, **splats)
    compile_for(capability, lists.emit, 1, BLOCK=32, ROW=16, FOOTPRINT=footprint)
    compile_for(capability, blend.blend, 1, WEIGHTS=switches, **tiles)
    compile_for(capability, blend.blend_backward, 1, DEPTH=switches, SUMS=sums, **tiles)
    compile_for(capability, lists.per_splat, 1, COLUMNS=sums, WIDTH=16, MAXIMUM=False, SPLATS=8, AT_ONCE=4)
    compile_for(capability, lists.per_splat, 1, COLUMNS=1, WIDTH=1, MAXIMUM=True, SPLATS=8, AT_ONCE=4)
    compile_for(capability, projection_backward.project_backward, 2, POSE=switches, SUMS=sums, **splats)
    compile_for(capability, ssim.similarity, 4, ROWS=16, COLUMNS=128)
    compile_for(capability, ssim.loss_gradient, 4, WEIGHTED=switches, ROWS=16, COLUMNS=128)

compile_all(80, 4, True)
for capability in (75, 90):  # as a run with the defaults launches them
    compile_all(capability, 1, False)
"""


def test_kernels_compile_without_a_gpu(tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, cwd=Path(__file__).parents[3], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(done.stdout.splitlines()) == 3 * 9
