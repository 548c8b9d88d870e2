"""A program that uses Hydra itself can map: its own configuration is as it was afterwards."""

from __future__ import annotations

from pathlib import Path

import hydra
import pytest
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.version import getbase

from launch.compose import compose
from launch.refusal import GraphError


def test_a_graph_is_composed_where_hydra_is_at_work(tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text("weight: 3\n")
    with initialize_config_dir(version_base="1.2", config_dir=str(tmp_path)):
        before = GlobalHydra.instance()
        assert "mapper" in compose([]).slots
        with pytest.raises(GraphError):
            compose(["~nothing"])  # which Hydra refuses
        assert GlobalHydra.instance() is before
        assert hydra.compose("theirs").weight == 3
        assert str(getbase()) == "1.2"
    assert not GlobalHydra.instance().is_initialized()
    assert "mapper" in compose([]).slots
