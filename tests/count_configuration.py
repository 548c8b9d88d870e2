"""Counts what of the configuration is written in more than one place: `python -m tests.count_configuration`.

A parameter has one place, a dataclass: the core's, which a node's `Config` inherits or nests. Counted are

- fields that a node's `Config` declares although a dataclass of the core that it, or its module, uses has them;
- values in a choice's file, or in config.yaml, that the dataclass has as its default;
- arguments that hand a field of the same name from one configuration to the constructor of another.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

import nodes
from launch.compose import CONF
from launch.graph import Placement, load_node
from launch.settings import Settings
from nodes.parameters import Parameter, build, parameter_names, parameters

ROOT = Path(__file__).resolve().parent.parent


def twice() -> list[str]:
    """One line for each."""
    return [*_declared_again(), *_given_again(), *_copied()]


def _declared_again() -> Iterator[str]:
    for node in _nodes():
        used = {kind for kind in vars(sys.modules[node.__module__]).values() if _of_the_core(kind)}
        used |= {kind for kind in node.Config.__mro__ if _of_the_core(kind)}
        used |= {parameter.owner for parameter in parameters(node.Config) if _of_the_core(parameter.owner)}
        for name in inspect.get_annotations(node.Config):
            for kind in sorted(used, key=lambda kind: kind.__name__):
                if name in {field.name for field in fields(kind)}:
                    yield f"{node.__module__}.{node.__qualname__}.Config.{name}: {kind.__name__} has it too"


def _nodes() -> list[type[nodes.Node]]:
    modules = [importlib.import_module(f"nodes.{file.stem}") for file in sorted((ROOT / "nodes").glob("[a-z]*.py"))]
    found = [kind for module in modules for kind in vars(module).values() if isinstance(kind, type)]
    return sorted({kind for kind in found if issubclass(kind, nodes.Node)}, key=lambda kind: kind.__qualname__)


def _of_the_core(kind: Any) -> bool:
    """Whether it is a dataclass of parameters of the core: all of its fields have defaults, or are such."""
    if not (isinstance(kind, type) and is_dataclass(kind) and kind.__module__.startswith("mvsgs_core")):
        return False
    return all(field.default is not MISSING or field.default_factory is not MISSING for field in fields(kind))


def _given_again() -> Iterator[str]:
    for file in sorted(CONF.glob("*/*.yaml")):
        content = yaml.safe_load(file.read_text())
        if content["_target_"] is not None:
            node = load_node(file.parent.name, content["_target_"])
            own = {key: value for key, value in content.items() if key in parameter_names(node.Config)}
            yield from _equal(file, content, parameters(node.Config))
            yield from _equal(file, content, parameters(Placement))
            for mapping, keys in node.keys_of(build(node.Config, own)).items():
                yield from _equal(file, content.get(mapping, {}), keys)
    yield from _equal(CONF / "config.yaml", yaml.safe_load((CONF / "config.yaml").read_text()), parameters(Settings))


def _equal(file: Path, content: Mapping[str, Any], declared: Iterable[Parameter]) -> Iterator[str]:
    for parameter in declared:
        value: Any = content
        for key in parameter.path.split("."):
            value = value.get(key, MISSING) if isinstance(value, Mapping) else MISSING
        if value is not MISSING and value == parameter.default:
            yield f"{file.relative_to(ROOT)}: {parameter.path}: {value} is the default"


def _copied() -> Iterator[str]:
    for file in [*(ROOT / "nodes").rglob("*.py"), *(ROOT / "launch").glob("*.py")]:
        for call in ast.walk(ast.parse(file.read_text())):
            if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("Config"):
                for given in call.keywords:
                    if isinstance(given.value, ast.Attribute) and given.value.attr == given.arg:
                        yield f"{file.relative_to(ROOT)}:{call.lineno}: {given.arg} is handed on by hand"


if __name__ == "__main__":
    found = twice()
    print("\n".join([*found, f"{len(found)} parameters are written in more than one place"]))
    sys.exit(bool(found))
