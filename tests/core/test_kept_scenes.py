"""Lit scenes: built once, the same from the disk, made anew where the file is no good; color or depth of them alone."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.scene import kept as module
from mvsgs_core.scene.kept import folder, kept
from mvsgs_core.scene.lighting import Lighting
from mvsgs_core.scene.lit import LitScene, lit
from mvsgs_core.scene.patches import Patch, quad
from mvsgs_core.scene.renderer import Rendering, SceneRenderer

LIGHT = Lighting(texel=0.5, horizon=(0.2, 0.3, 0.4), below=(0.9, 0.8, 0.7))


class Builder:
    """Builds a scene of two sheets of paper, and counts how often."""

    def __init__(self) -> None:
        self.built = 0

    def __call__(self) -> LitScene:
        self.built += 1
        texture = np.random.default_rng(0).integers(0, 255, (8, 6, 3), dtype=np.uint8)
        sheets = [quad((-3, -3, 4), (6, 0, 0), (0, 6, 0)), quad((-1, -1, 2), (1, 0, 0), (0, 1, 0))]
        return lit([Patch(points, texture) for points in sheets], LIGHT, threads=1)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    own = folder()
    assert own == tmp_path / "mvsgs" / "scenes"
    return own


def view(scene: LitScene) -> np.ndarray:
    return SceneRenderer(scene).render(np.eye(4), np.array([40.0, 40.0, 19.5, 14.5]), (30, 40), threads=1).color


def test_it_is_built_once_and_looks_the_same_from_the_disk() -> None:
    build = Builder()
    first, second = kept("paper", build), kept("paper", build)
    assert build.built == 1
    assert view(first).std() > 0.01
    np.testing.assert_array_equal(view(first), view(second))
    kept("another paper", build)
    assert build.built == 2


def test_without_a_place_to_keep_it_it_is_built_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "folder", lambda: None)
    build = Builder()
    assert view(kept("paper", build)).std() > 0.01
    kept("paper", build)
    assert build.built == 2


def test_one_of_other_code_is_another_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    build = Builder()
    kept("paper", build)
    monkeypatch.setattr(module, "_code", lambda: "other code")
    kept("paper", build)
    assert build.built == 2


@pytest.mark.parametrize("damage", ["empty", "cut", "changed"])
def test_a_damaged_file_is_made_anew(own_folder: Path, damage: str) -> None:
    build = Builder()
    whole = kept("paper", build)
    (file,) = own_folder.iterdir()
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 255
    file.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "changed": data}[damage])
    np.testing.assert_array_equal(view(kept("paper", build)), view(whole))
    kept("paper", build)
    assert build.built == 2


def test_where_nothing_can_be_written_it_is_built_each_time(own_folder: Path) -> None:
    own_folder.parent.mkdir()
    own_folder.write_text("no folder")
    build = Builder()
    np.testing.assert_array_equal(view(kept("paper", build)), view(kept("paper", build)))
    assert build.built == 2


def test_what_can_be_read_alone_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("not the owner")

    build = Builder()
    kept("paper", build)
    monkeypatch.setattr(module.os, "utime", refuse)
    kept("paper", build)
    assert build.built == 1


def test_those_not_used_for_longest_make_room(own_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LIMIT", 2)
    build = Builder()
    for second, name in enumerate(("first", "second"), 1):
        before = set(own_folder.glob("*"))
        kept(name, build)
        (file,) = set(own_folder.iterdir()) - before
        os.utime(file, (second, second))
    kept("first", build)
    kept("third", build)
    assert len(list(own_folder.iterdir())) == 2
    kept("first", build)
    assert build.built == 3
    kept("second", build)
    assert build.built == 4


def test_what_is_not_wanted_is_not_rendered_and_the_rest_is_the_same() -> None:
    def render(**wanted: bool) -> Rendering:
        return renderer.render(np.eye(4), np.array([40.0, 40.0, 19.5, 14.5]), (30, 40), threads=1, **wanted)

    renderer = SceneRenderer(Builder()())
    both, color, depth = render(), render(depth=False), render(color=False)
    assert both.depth.std() > 0.1
    np.testing.assert_array_equal(color.color, both.color)
    np.testing.assert_array_equal(depth.depth, both.depth)
    assert color.depth.size == depth.color.size == 0
