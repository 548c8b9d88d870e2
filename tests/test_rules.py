"""Rules of the whole repository that no other tool checks."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.support.shared_data import ROOT

PACKAGES = ("msgs", "nodes", "launch", "mvsgs", "mvsgs_core", "examples")  # the product; others may use more
SOURCES = {".py", ".cpp", ".h", ".hpp", ".cu", ".yaml", ".txt", ".toml", ".js", ".html"}
MAX_LINES = 400
SERIALIZERS = {"dill", "cloudpickle", "joblib", "shelve", "marshal", "msgpack_numpy"}


def python_files(*packages: str) -> list[Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


@cache
def imports(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, wherever in it, relative ones as their package."""
    found = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


@cache
def calls(path: Path) -> tuple[ast.Call, ...]:
    return tuple(node for node in ast.walk(tree(path)) if isinstance(node, ast.Call))


def called(call: ast.Call) -> str:
    """The text of what is called."""
    return ast.unparse(call.func)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.slow
def test_only_the_transport_imports_zmq() -> None:
    users = [path for path in python_files(*PACKAGES) if "zmq" in imports(path)]
    assert {name(path.parent) for path in users} == {"nodes/runtime/transport"}


@pytest.mark.slow
def test_only_one_file_imports_dds() -> None:
    assert [name(path) for path in python_files(*PACKAGES) if "cyclonedds" in imports(path)] == ["nodes/ros2/dds.py"]


@pytest.mark.slow
def test_the_core_knows_no_node_and_no_message() -> None:
    files = python_files("mvsgs_core")
    assert files
    assert {name(p): imports(p) & {"msgs", "nodes", "launch", "zmq"} for p in files} == {name(p): set() for p in files}


def test_messages_know_neither_torch_nor_nodes() -> None:
    files = python_files("msgs")
    assert {name(p): imports(p) & {"torch", "nodes", "launch"} for p in files} == {name(p): set() for p in files}


def test_importing_messages_and_the_transport_loads_no_torch() -> None:
    heavy = {"torch", "cv2", "open3d", "hydra"}
    modules = "nodes.runtime.process, msgs.codec, tests.support.sample_nodes"  # the tests start the last by the dozen
    code = f"import sys, {modules}; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_nothing_is_pickled() -> None:
    for path in python_files(*PACKAGES, "bench"):
        assert not imports(path) & SERIALIZERS, name(path)
        text = path.read_text()  # the name of pickle's exception is needed to refuse a file
        assert "from pickle" not in text, name(path)
        assert set(re.findall(r"\bpickle\.\w+", text)) <= {"pickle.UnpicklingError"}, name(path)
        for call in calls(path):
            unsafe = any(k.arg == "allow_pickle" and ast.unparse(k.value) != "False" for k in call.keywords)
            assert not unsafe, f"{name(path)}:{call.lineno}: {called(call)} with allow_pickle"


@pytest.mark.slow
def test_weights_are_loaded_without_code() -> None:
    for path in python_files(*PACKAGES, "bench", "tests"):
        loads = [c for c in calls(path) if isinstance(c.func, ast.Attribute) and c.func.attr == "load"]
        for call in loads:
            if called(call).endswith("torch.load"):
                safe = any(k.arg == "weights_only" and ast.unparse(k.value) == "True" for k in call.keywords)
                assert safe, f"{name(path)}:{call.lineno}: torch.load without weights_only=True"


def tracked_files() -> list[Path]:
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout: which files belong to the project is unknown")
    anybodys = ["-c", "safe.directory=*"]  # as where a container's user runs the tests of a checkout from outside
    command = ["git", *anybodys, "ls-files", "-co", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [path for line in done.stdout.splitlines() if (path := ROOT / line).is_file()]


def test_no_file_has_more_than_400_lines() -> None:
    sources = [path for path in tracked_files() if path.suffix in SOURCES and path.name != "constraints.txt"]
    assert len(sources) > 50
    lengths = {name(path): len(path.read_text().splitlines()) for path in sources}
    assert {path: lines for path, lines in lengths.items() if lines > MAX_LINES} == {}


def test_no_module_is_called_utils() -> None:
    assert [name(p) for p in tracked_files() if p.stem in {"utils", "util", "helpers", "misc", "common"}] == []


@pytest.mark.slow
def test_tests_share_what_lies_in_support_only() -> None:
    found = [
        f"{name(path)}: {node.module}"
        for path in python_files("tests")
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ImportFrom) and node.module and ".test_" in f".{node.module}"
    ]
    assert found == []
