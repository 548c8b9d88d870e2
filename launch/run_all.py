"""Starts the whole graph: `python launch/run_all.py dataset=tum dataset.path=... mapper.iterations=300 viewer=off`.

From any directory. `--help` lists slots, choices and parameters; `-m` sweeps; `--inline` runs all in this process.
"""

from __future__ import annotations

# ruff: noqa: E402, PTH100, PTH109, PTH118, PTH120
import os  # this and sys are loaded already: nothing else is imported before the path is in order
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
# The workspace first: `launch`, `nodes` and `msgs` are generic names. The current directory only where PYTHONPATH names
# it: nothing that lies among a user's data may take a module's place (`mvsgs_core.named_modules` looks there, last).
_NAMED = {os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path}
_LEFT_OUT = {ROOT, os.path.join(ROOT, "launch"), ""} | ({os.getcwd()} - _NAMED)
sys.path[:] = [ROOT] + [path for path in sys.path if path not in _LEFT_OUT]

import signal
from collections.abc import Sequence
from pathlib import Path

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # before a run there is nothing to finish: no traceback of an import

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from launch.children import python_environment
from launch.compose import CONF, prepare
from launch.jobs import Job, run
from launch.parameters import GraphError


def main(arguments: Sequence[str]) -> int:
    """Runs the command line; returns the exit code: 0, 1 a node failed, 2 refused, 130 stopped by Ctrl-C."""
    try:
        sys.argv[1:] = hydra_arguments(arguments)
    except GraphError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    os.environ |= python_environment()  # Hydra's launchers start workers that need the workspace too
    codes: list[int] = []

    @hydra.main(version_base="1.3", config_path="conf", config_name="config")
    def job(config: DictConfig) -> None:
        codes.append(run(Job.of(config, HydraConfig.get())))

    job()
    return codes[-1] if codes else 0


def hydra_arguments(arguments: Sequence[str]) -> list[str]:
    """The command line as Hydra takes it. Raises GraphError for overrides that name nothing there is."""
    words = ["inline=true" if word == "--inline" else word for word in arguments]
    conf = Path(_option(words, "--config-path", "-cp") or CONF).absolute()
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    elsewhere = _option(words, "--config-dir", "-cd") or any(word.startswith("hydra.searchpath") for word in overrides)
    prepared = prepare(overrides, conf, all_choices_known=not elsewhere)
    if {"-m", "--multirun"} & set(words):
        # each job's output is a numbered directory in the one that was asked for
        prepared += [f"hydra.sweep.dir={text.partition('=')[2]}" for text in overrides if text.startswith("output=")]
    return [word for word in words if word not in overrides] + prepared


def _option(words: Sequence[str], *names: str) -> str | None:
    for i, word in enumerate(words):
        name, _, value = word.partition("=")
        if name in names:
            return value or (words[i + 1] if i + 1 < len(words) else None)
    return None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
