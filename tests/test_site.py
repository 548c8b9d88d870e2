"""The site of the documents and docstrings: its parts are there, and it builds where its tools are installed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from tests.support.shared_data import ROOT

OWN = ROOT / "build" / "site" / "venv" / "bin" / "python"  # of `make docs`


@pytest.fixture(scope="module")
def stage() -> ModuleType:
    spec = spec_from_file_location("stage", ROOT / "docs" / "site" / "stage.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pages(nav: list[object] | dict[str, object] | str) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    values = nav.values() if isinstance(nav, dict) else nav
    return [page for value in values for page in pages(value)]  # type: ignore[arg-type]


def test_what_it_is_made_of_is_there(stage: ModuleType, tmp_path: Path) -> None:
    staged = {page.relative_to(tmp_path).as_posix() for page in stage.stage(staged=tmp_path)}
    named = pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert set(named) <= staged
    guides = {f"docs/guides/{guide.name}" for guide in (ROOT / "docs" / "guides").glob("*.md")}
    assert guides <= set(named), "a guide is missing from the nav of mkdocs.yml"
    assert {page for page in staged if page.startswith("reference/")} <= set(named)
    for _, _, described in stage.REFERENCE.values():
        for name in described:
            file = ROOT / Path(*name.split("."))
            known = file.is_dir() or file.with_suffix(".py").is_file()
            owner = file.parent / "__init__.py" if file.parent.is_dir() else file.parent.with_suffix(".py")
            assert known or re.search(rf"^(class|def) {file.name}\b", owner.read_text(), re.MULTILINE), name


@pytest.mark.slow
def test_it_builds_and_loads_nothing_from_elsewhere(stage: ModuleType, tmp_path: Path) -> None:
    python = Path(sys.executable) if find_spec("mkdocs") and find_spec("mkdocstrings") else OWN
    if not python.exists():
        pytest.skip("mkdocs is not installed: `make docs` installs it beside the rest")
    stage.stage(staged=tmp_path / "source")
    config = (ROOT / "mkdocs.yml").read_text()
    for folder, here in (("build/site/source", tmp_path / "source"), ("build/site/html", tmp_path / "html")):
        assert folder in config
        config = config.replace(folder, str(here))
    config = config.replace("[.]", f"[{ROOT}]").replace(
        "docs/site/field_comments.py", f"{ROOT}/docs/site/field_comments.py"
    )
    (tmp_path / "mkdocs.yml").write_text(config)
    built = subprocess.run(
        [python, "-m", "mkdocs", "build", "--strict"], cwd=tmp_path, capture_output=True, text=True, timeout=200,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    for page in (tmp_path / "html").rglob("*.html"):
        assert not re.findall(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"?(?:https?:)?//", page.read_text()), (
            page
        )
    program = (tmp_path / "html" / "reference" / "program.html").read_text()
    assert "NaN where there is none" in program  # of a docstring
    assert "before later corrections" in program  # of a field's comment
    assert "each frame comes with its pose" in program  # of the constructor
