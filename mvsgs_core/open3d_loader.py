"""open3d, imported late: it takes a second and 200 MB, and links libusb even where no camera is used."""

from __future__ import annotations

import ctypes
import functools
from types import ModuleType


@functools.cache
def open3d() -> ModuleType:
    """The open3d module. Raises ImportError with the command that mends a missing libusb."""
    try:  # the pip package carries the library; the loader then finds it by its name
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # a system-wide libusb serves as well; what is missing is said below
    try:
        import open3d as o3d
    except OSError as error:
        raise ImportError(f"open3d does not load ({error}): apt install libusb-1.0-0 libgl1 libgomp1") from error
    return o3d
