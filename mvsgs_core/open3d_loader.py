"""open3d, imported late: it takes a second and 200 MB, and links libusb and OpenGL even without camera and screen."""

from __future__ import annotations

import ctypes
import functools
from types import ModuleType


@functools.cache
def open3d() -> ModuleType:
    """The open3d module. Raises ImportError with the command that mends a missing library of the system's."""
    try:  # the pip package carries the library; the loader then finds it by its name
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # a system-wide libusb serves as well; what is missing is said below
    try:
        import open3d as o3d
    except ModuleNotFoundError:
        raise  # open3d itself, which no library of the system's brings
    except (ImportError, OSError) as error:
        mended = "sudo apt install libegl1 libgl1 libgomp1 libusb-1.0-0"
        raise ImportError(f"open3d does not load ({error}): {mended}") from error
    return o3d
