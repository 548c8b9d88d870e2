"""Where a library of the system's is missing, which pip does not bring, open3d says what to install."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from typing import Any

import pytest

from mvsgs_core.open3d_loader import open3d


class WithoutEgl(MetaPathFinder):
    def find_spec(self, name: str, *_: Any) -> None:
        if name == "open3d":
            raise ImportError("libEGL.so.1: cannot open shared object file: No such file or directory")


def test_a_missing_library_is_named_with_what_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [WithoutEgl(), *sys.meta_path])
    with pytest.raises(ImportError, match=r"libEGL.so.1.* sudo apt install libegl1 "):
        open3d.__wrapped__()


def test_an_open3d_that_is_not_installed_is_no_matter_of_the_system_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ModuleNotFoundError) as refused:
        open3d.__wrapped__()
    assert "apt install" not in str(refused.value)
