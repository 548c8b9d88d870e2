"""Files that are whole or not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvsgs_core.atomic_file import replace_text, replacing


def test_the_new_file_takes_the_place_of_the_old_one_and_nothing_is_left_aside(tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    file.write_text("old")
    with replacing(file) as aside:
        aside.write_text("ne")
        assert file.read_text() == "old"
        assert aside.suffix == ".json"
        aside.write_text("new")
    assert file.read_text() == "new"
    assert list(tmp_path.iterdir()) == [file]


def test_a_failure_on_the_way_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "map.ply"
    file.write_text("old")

    def fail() -> None:
        with replacing(file) as aside:
            aside.write_text("half")
            raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space"):
        fail()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_text_is_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    replace_text(tmp_path / "note.txt", "größer als 5 €")
    assert (tmp_path / "note.txt").read_bytes() == "größer als 5 €".encode()
