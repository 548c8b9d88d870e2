"""Optional modules."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from mvsgs_core.named_modules import is_installed


def test_a_folder_of_an_optional_modules_name_is_not_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a clone of it beside this checkout, whose parent an editable installation puts on the path."""
    (tmp_path / "optional_module" / "source").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path)
    assert not is_installed("optional_module")
    (tmp_path / "optional_module" / "__init__.py").touch()
    importlib.invalidate_caches()
    assert is_installed("optional_module")
    assert not is_installed("no_such_module")
