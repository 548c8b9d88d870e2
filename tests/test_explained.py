"""Which failures of a node are shown without their traceback."""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.files import Layout
from nodes.runtime.explained import is_explained


def bad_file() -> None:
    raise BadFileError("walk.bag is no bag")


def camera() -> None:
    raise OSError("camera 3 does not answer: is it plugged in?")


def no_folder() -> None:
    Layout("A bag", "a file", "your robot").present("/nowhere/at/all")


def of_the_system() -> None:
    Path("/nowhere/at/all").read_text()


def of_a_library() -> None:
    ctypes.CDLL("libnowhere.so")


def of_the_interpreter() -> None:
    exec("def made(): pass", made := {})
    inspect.getsource(made["made"])


def a_fault() -> None:
    raise ValueError("operands could not be broadcast together")


@pytest.mark.parametrize(
    ("failing", "explained"),
    [
        (bad_file, True), (camera, True), (no_folder, True), (of_the_system, False), (of_a_library, False),
        (of_the_interpreter, False), (a_fault, False),
    ],
)  # fmt: skip
def test_what_a_user_is_told_without_a_traceback(failing: Callable[[], None], explained: bool) -> None:
    with pytest.raises(Exception) as raised:
        failing()
    assert is_explained(raised.value) == explained
