"""What constraints.txt pins goes together: the build of PyTorch that is tested with may ask for less than another."""

from __future__ import annotations

import importlib.metadata
import tomllib
from importlib.metadata import PackageNotFoundError

import pytest
from packaging.requirements import Requirement

from tests.support.shared_data import ROOT

# PyTorch: the Triton that its build for CUDA, PyPI's on Linux, requires; the one for processors alone requires none
TRITON_OF = {"2.13.0": "3.7.1"}


NO_WHEEL = {  # that PyPI has none of for Linux, by machine and version of Python (3.14 has zstd itself)
    ("x86_64", "3.11"): set[str](),
    ("x86_64", "3.14"): {"backports-zstd", "cyclonedds"},
    ("aarch64", "3.11"): {"cyclonedds", "pycolmap"},
}


def requirements() -> list[Requirement]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return [Requirement(line) for line in lines if not line.startswith("#")]


def pinned(name: str) -> str:
    (found,) = [requirement for requirement in requirements() if requirement.name == name]
    return str(found.specifier).removeprefix("==")


@pytest.mark.parametrize(("machine", "python"), NO_WHEEL)
def test_nothing_is_asked_for_that_has_no_wheel(machine: str, python: str) -> None:
    there = {"platform_system": "Linux", "platform_machine": machine, "python_version": python}
    left_out = {found.name for found in requirements() if found.marker and not found.marker.evaluate(there)}
    assert left_out == NO_WHEEL[machine, python]


def test_all_that_is_asked_for_is_pinned_but_what_the_header_names() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    header = (ROOT / "constraints.txt").read_text().partition("annotated-types")[0]
    extras = project["optional-dependencies"]
    unpinned = {extra for extra in extras if f"`{extra}`" in header}
    assert unpinned == {"docs", "ray"}
    asked = [*project["dependencies"], *(line for extra in extras.keys() - unpinned for line in extras[extra])]
    for requirement in map(Requirement, asked):
        assert requirement.specifier.contains(pinned(requirement.name)), requirement


def test_triton_is_the_one_that_torch_asks_for() -> None:
    torch = pinned("torch")
    assert torch in TRITON_OF, f"look up which triton the metadata of torch {torch} on PyPI requires"
    assert pinned("triton") == TRITON_OF[torch]


def test_the_installed_torch_asks_for_no_other_triton() -> None:
    try:
        requires = importlib.metadata.requires("torch") or []
    except PackageNotFoundError:
        pytest.skip("torch has no metadata here")
    asked = [requirement for line in requires if (requirement := Requirement(line)).name == "triton"]
    if not asked or (asked[0].marker and not asked[0].marker.evaluate()):
        pytest.skip("this build of torch asks for no triton")
    assert pinned("triton") in asked[0].specifier
