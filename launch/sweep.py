"""Where a sweep's runs are: Hydra's launchers may run them in other processes, or on a cluster's other machines."""

from __future__ import annotations

import importlib.util
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import ValueType
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from launch.checks import check
from launch.compose import compose, parse
from launch.output import make_folder, new_folder
from launch.refusal import GraphError

SUBMITIT = "hydra_plugins.hydra_submitit_launcher"
GRAIN = 2.0  # seconds by which a file system's times, or another host's clock, may be behind

_folders: dict[Path, float] = {}  # and when the sweep began, seconds since 1970


class SweepFolder(Callback):
    """Hydra's callback in conf/config.yaml: keeps in this process which folder the sweep's jobs have in common."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        _folders[Path(config.hydra.sweep.dir)] = time.time()


def check_launcher(words: Sequence[str]) -> None:
    """Raises GraphError for a sweep on a Slurm cluster without what hands its jobs on."""
    for word in words:
        if word.startswith("hydra/launcher=submitit") and importlib.util.find_spec(SUBMITIT) is None:
            raise GraphError(f"{word} needs Hydra's launcher for Slurm: pip install 'hydra-submitit-launcher>=1.2'")
        if word == "hydra/launcher=submitit_slurm" and shutil.which("srun") is None:
            raise GraphError(f"{word}: Slurm's srun is not on this machine; hydra/launcher=submitit_local does without")


def check_single(overrides: Sequence[str]) -> None:
    """Raises GraphError for several values of one parameter: without -m that is no sweep, and no list either."""
    for override in map(parse, overrides):
        if override.is_sweep_override():
            text, key = str(override.input_line), override.key_or_group
            plain = override.value_type is ValueType.SIMPLE_CHOICE_SWEEP
            written = f"a list is written {key}=[{text.partition('=')[2]}], and " if plain else ""
            raise GraphError(f"{text}: {written}a sweep over several values takes -m")


def check_jobs(overrides: Sequence[str], conf: Path) -> None:
    """Raises GraphError where a job of a sweep on this machine cannot run, before the first one does."""
    own = [override for override in map(parse, overrides) if not override.key_or_group.startswith("hydra")]
    try:
        jobs = BasicSweeper.split_arguments(own, None)[0]
    except HydraException:
        return  # Hydra refuses it itself, or needs to know the choices: glob(*)
    for number, words in enumerate(jobs):
        try:
            check(compose(words, conf))
        except GraphError as error:
            raise GraphError(f"job {number} of the sweep: {error}") from error


def named_folder(overrides: Sequence[str]) -> Path | None:
    """What `output=` names, in which each job of a sweep has a numbered folder; None where it names nothing.

    Raises GraphError where it is no name of one folder.
    """
    given = [override for override in map(parse, overrides) if override.key_or_group == "output"]
    if not given:
        return None
    override, text = given[-1], str(given[-1].input_line)
    if override.is_sweep_override():
        raise GraphError(f"{text}: the jobs of a sweep are numbered folders in one output; give one name")
    value = override.value()
    if isinstance(value, int | float):  # as of a run, a folder may have such a name
        value = text.partition("=")[2]
    if not isinstance(value, str | None):
        raise GraphError(f"{text}: must be the name of a folder; write output=./NAME")
    try:
        name = OmegaConf.create({"output": value}).output
    except OmegaConfBaseException as error:
        said = str(error).splitlines()[0]
        raise GraphError(f"{text}: a sweep's output takes no value of another key: {said}") from error
    return Path(name).expanduser().absolute() if name else None


def made_folder(named: Path | None) -> Path:
    """The folder of a sweep's jobs, now there: the one that is named, or else one that no other sweep has.

    Raises GraphError where there can be none.
    """
    folder = named or new_folder(Path(f"runs/{time.strftime('%Y-%m-%d_%H-%M-%S')}-sweep").absolute())
    make_folder(folder)
    return folder


def swept() -> list[Path]:
    """The outputs of the jobs of this process's sweep, in their order; none where nothing was swept.

    What an earlier sweep left in the same folder, of more jobs, is none of them.
    """
    found = [
        (int(folder.name), folder)
        for sweep, began in _folders.items()
        for folder in (sweep.iterdir() if sweep.is_dir() else ())
        if folder.name.isdigit() and folder.stat().st_mtime > began - GRAIN
    ]
    return [folder for _, folder in sorted(found)]
