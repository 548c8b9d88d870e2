"""The wheel's Python part: no generic name lands in site-packages, and the command runs from what is there.

The kernels, which take minutes to build, are those of this checkout.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wheel is unpacked."""
    pytest.importorskip("scikit_build_core")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    built = subprocess.run(
        [*command, "--wheel-dir", folder, "-Cwheel.cmake=false", ROOT], capture_output=True, text=True, timeout=200
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("mvsgs-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    for kernels in (ROOT / "mvsgs_core").glob("*.so"):
        shutil.copy(kernels, folder / "site" / "mvsgs_core")
    return folder / "site"


def test_only_our_own_names_are_in_site_packages(site: Path) -> None:
    top = {path.name for path in site.iterdir() if not path.name.endswith(".dist-info")}
    assert top == {"mvsgs", "mvsgs_core"}
    for name in ("launch/conf/config.yaml", "launch/run_all.py", "nodes/__main__.py", "msgs/__init__.py"):
        assert (site / "mvsgs/workspace" / name).is_file(), name
    assert not list(site.rglob("csrc"))
    (points,) = site.glob("*.dist-info/entry_points.txt")
    assert "mvsgs = mvsgs.command:main" in points.read_text()


def test_a_program_maps_from_there(site: Path, tmp_path: Path) -> None:
    program = (
        "import sys; sys.meta_path = [f for f in sys.meta_path if 'editable' not in f.__module__]; "  # the checkout
        f"sys.path.insert(0, {str(site)!r}); from mvsgs_core import Mapping; Mapping('device=cpu'); import nodes; "
        "print(nodes.__file__)"
    )
    done = subprocess.run([sys.executable, "-I", "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == f"{site / 'mvsgs/workspace/nodes/__init__.py'}\n", done.stderr


def test_the_command_runs_from_there(site: Path, tmp_path: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        start = (
            "import sys; sys.meta_path = [f for f in sys.meta_path if 'editable' not in f.__module__]; "  # the checkout
            f"sys.path.insert(0, {str(site)!r}); from mvsgs.command import main; sys.exit(main())"
        )
        return subprocess.run(
            [sys.executable, "-I", "-c", start, *words],
            cwd=tmp_path, capture_output=True, text=True, timeout=200, env={**os.environ, "PYTHONPATH": str(site)},
        )  # fmt: skip

    shown = run("graph", "dataset=synthetic")
    assert shown.returncode == 0, shown.stderr
    assert "mapper=ges" in shown.stdout
    looked = run("doctor", "--no-test")
    assert str(site / "mvsgs" / "workspace") in looked.stdout, looked.stderr
    mapped = run("demo", "dataset.stop=12", "dataset.size=[60,80]", "mapper.iterations=3", "mapper.refinement=3",
                 "tracker=ground_truth", "evaluator._target_=null", f"output={tmp_path / 'out'}")  # fmt: skip
    assert mapped.returncode == 0, mapped.stdout + mapped.stderr
    assert (tmp_path / "out/map.ply").is_file()
