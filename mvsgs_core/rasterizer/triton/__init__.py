"""The rasterizer and its loss for GPUs in Triton: no CUDA compiler needed."""

try:
    import triton as _triton  # noqa: F401
except ModuleNotFoundError as error:
    raise ImportError(
        "a GPU needs the package triton, which comes with torch's CUDA builds: take backend='cpu' or 'reference', or "
        "device=cpu"
    ) from error
