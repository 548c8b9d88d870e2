"""The rasterizer and its loss for GPUs in Triton: no CUDA compiler needed."""

import os

from mvsgs_core.cache_folder import written_folder

try:
    import triton as _triton  # noqa: F401
except ModuleNotFoundError as error:
    raise ImportError(
        "a GPU needs the package triton, which comes with torch's CUDA builds: take backend='cpu' or 'reference', or "
        "device=cpu"
    ) from error

if not os.environ.keys() & {"TRITON_CACHE_DIR", "TRITON_HOME"}:  # else it keeps what it compiles in a home, or fails
    os.environ["TRITON_CACHE_DIR"] = str(written_folder("triton"))
