"""Which failures a user is told in their message alone."""

from __future__ import annotations

import sysconfig
from pathlib import Path

from mvsgs_core.bad_file import BadFileError

OURS = ("nodes", "mvsgs_core", "msgs")  # which may be installed among the libraries
LIBRARIES = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]


def is_explained(error: Exception) -> bool:
    """Whether it is of the input, in a sentence that somebody wrote for the user, who is not helped by where in the
    code that was. An OSError of the system has a number, and one of a library was raised in its folder."""
    if isinstance(error, BadFileError):
        return True
    if not isinstance(error, OSError) or error.errno is not None or not error.args or error.__traceback__ is None:
        return False
    last = error.__traceback__
    while last.tb_next is not None:
        last = last.tb_next
    module, file = last.tb_frame.f_globals.get("__name__", ""), Path(last.tb_frame.f_code.co_filename)
    return module.partition(".")[0] in OURS or not any(map(file.is_relative_to, LIBRARIES))


__all__ = ["is_explained"]
