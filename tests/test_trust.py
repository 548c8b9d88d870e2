"""Whom the system trusts: not the folder it is started in, not who happens to connect."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from launch.children import python_environment
from tests.support.dataset_folders import write_photos
from tests.support.launches import FAKE
from tests.support.shared_data import ROOT

STRANGERS = ("hydra", "psutil", "difflib", "json", "numpy", "cv2", "torch", "omegaconf", "msgpack", "queue", "signal")
STRANGER = "import pathlib; pathlib.Path(__file__).with_suffix('.ran').touch()\n"
OWN_NODE = '''
"""A user's own node, with a module of theirs beside it."""
from tests.support.fake_graph.stages import Relay
import beside_it

class Mine(Relay):
    pass
'''


def run_in(folder: Path, *arguments: str, path: str = "") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "launch/run_all.py"), f"output={folder / 'out'}", *arguments]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=240, env=environment)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A user's folder of data in which files lie that have the names of modules."""
    for name in STRANGERS:
        (tmp_path / f"{name}.py").write_text(STRANGER)
    return tmp_path


def ran(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.rglob("*.ran"))


@pytest.mark.slow
def test_nothing_beside_the_data_is_imported(folder: Path) -> None:
    write_photos(folder, 6)
    done = run_in(folder, "dataset=images", "dataset.path=.", "dataset.intrinsics=[60,60,31.5,23.5]", "device=cpu")
    assert "ModuleNotFoundError" not in done.stderr
    assert (folder / "out/logs/tracker.log").exists(), done.stdout + done.stderr  # its processes have run
    assert ran(folder) == []


@pytest.mark.slow
@pytest.mark.parametrize("path", ["", f"{os.pathsep}{ROOT}", str(ROOT)], ids=["none", "empty entry", "repository"])
@pytest.mark.parametrize("how", [[], ["--inline"], ["-m", "relay.stride=1,2"]], ids=["processes", "inline", "sweep"])
def test_a_target_there_works_and_takes_no_other_modules_place(folder: Path, how: list[str], path: str) -> None:
    (folder / "my_node.py").write_text(OWN_NODE)
    (folder / "beside_it.py").write_text(STRANGER)
    arguments = ["--config-path", str(FAKE), "relay._target_=my_node.Mine", "source.count=4", *how]
    done = run_in(folder, *arguments, path=path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert ran(folder) == ["beside_it"]


def test_a_nodes_interpreter_does_not_look_where_it_is_started(folder: Path) -> None:
    code = "import json, nodes.runtime.process, sys; print(json.dumps(sys.path))"
    environment = {**os.environ, **python_environment()}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[0] == str(ROOT)
    assert str(folder) not in json.loads(done.stdout)
    assert ran(folder) == []


def test_each_directory_is_in_the_path_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), "/a", "", "/a"]))
    assert python_environment()["PYTHONPATH"] == os.pathsep.join([str(ROOT), "/a"])
