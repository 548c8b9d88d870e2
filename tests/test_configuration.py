"""Every parameter is written once; and what counts that sees it where one is not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from launch.settings import Settings
from mvsgs_core.mapping.config import MapperConfig
from nodes import Node
from nodes.parameters import parameters
from tests import count_configuration


def test_every_parameter_is_written_once() -> None:
    assert count_configuration.twice() == []


class Twice(Node):
    @dataclass(frozen=True)
    class Config(MapperConfig):
        iterations: int = 30
        own: int = 1


def test_what_is_written_twice_is_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(count_configuration, "_nodes", lambda: [Twice])
    assert list(count_configuration._declared_again()) == [
        f"{__name__}.Twice.Config.iterations: MapperConfig has it too"
    ]
    monkeypatch.setattr(count_configuration, "ROOT", tmp_path)
    file = tmp_path / "config.yaml"
    assert list(count_configuration._equal(file, {"seed": 1, "supervise": {"dead": 60.0}}, parameters(Settings))) == [
        "config.yaml: supervise.dead: 60.0 is the default"
    ]
    (tmp_path / "nodes").mkdir()
    (tmp_path / "nodes/copies.py").write_text("CoreConfig(window=c.window, area=c.size, steps=4)\n")
    assert list(count_configuration._copied()) == ["nodes/copies.py:1: window is handed on by hand"]
