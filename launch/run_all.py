"""Starts the whole graph: `python launch/run_all.py walk.mp4 mapper.iterations=300`; the command `mvsgs` runs it.

From any directory. `--help` lists slots, choices and parameters, `--graph` shows what is composed; `-m` sweeps;
`--inline` runs all in this process; `resume=DIR` goes on with an interrupted run in its own directory.
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

from launch.printing import flush, open_closed, say

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # before a run there is nothing to finish: no traceback of an import
    open_closed()

try:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    from launch.advice import advised
    from launch.children import python_environment
    from launch.comparison import comparison_page, comparison_text, has_figures
    from launch.compose import CONF, choices_of, graph_of, prepare
    from launch.graph_text import graph_text
    from launch.help_text import help_text
    from launch.jobs import Job, RunFailed, refused, run
    from launch.late_help import accept_late_help
    from launch.named_input import SLOT, quoted, with_named_input
    from launch.outcome import FAILED
    from launch.refusal import GraphError
    from launch.resume import WORD as RESUME
    from launch.resume import leave_out_refused, resumed_config
    from launch.sweep import check_jobs, check_launcher, check_single, made_folder, named_folder, swept
    from mvsgs_core.atomic_file import replace_text
    from mvsgs_core.printable import not_utf8
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}: run `make setup` once, then .venv/bin/mvsgs, or .venv/bin/python launch/run_all.py")

COMPARISON = "comparison.html"  # of a sweep
GRAPH = "--graph"
SHOWN = (GRAPH, "--help", "-h")  # --cfg, --info and --hydra-help are Hydra's own


def main(arguments: Sequence[str]) -> int:
    """Runs the command line; returns the exit code, see launch/outcome.py."""
    try:
        if problem := not_utf8([*arguments, os.getcwd()]):
            raise GraphError(problem)
        if any(word.startswith(RESUME) for word in arguments):
            return run(resumed_job(arguments))
        shown = next((word for word in arguments if word in SHOWN), None)
        sys.argv[1:] = hydra_arguments([word for word in arguments if word not in SHOWN])
    except GraphError as error:
        return refused(error)
    os.environ |= python_environment()  # Hydra's launchers start workers that need the workspace too
    accept_late_help()
    codes: list[int] = []
    failed: list[str] = []
    here = os.getpid()

    @hydra.main(version_base="1.3", config_path="conf", config_name="config")
    def job(config: DictConfig) -> None:
        one = Job.of(config, HydraConfig.get())
        one, notes = advised(one)
        for note in notes:
            say(f"note: {note}")
        try:
            codes.append(run(one) if shown is None else show(one, shown))
        except RunFailed as failure:
            if os.getpid() != here:
                raise  # in a worker, whose launcher hands it back
            failed.append(str(failure))

    try:
        job()
    finally:  # also where a job of a sweep has failed: Hydra exits then
        side_by_side(swept() if shown is None else [])
    if failed:
        say(f"error: {', '.join(failed)}", sys.stderr)
        return FAILED
    return codes[-1] if codes else 0


def side_by_side(outputs: Sequence[Path]) -> None:
    """At the end of a sweep: those of its runs that have figures, here and as a page in the folder of the sweep."""
    scored = [output for output in outputs if has_figures(output)]
    if len(scored) < 2:
        return
    say(f"\n{comparison_text(scored)}")
    file = Path(os.path.commonpath([output.absolute() for output in scored])) / COMPARISON
    try:
        replace_text(file, comparison_page(scored))
        say(f"{file}: the same with pictures")
    except (ValueError, OSError) as error:
        say(f"{file} could not be written: {error}")


def show(job: Job, shown: str) -> int:
    """Prints what a command line composes, and runs nothing."""
    try:
        graph = graph_of(job.config, job.overrides, job.choices)
    except GraphError as error:
        return refused(error)
    if shown == GRAPH:
        text = graph_text(graph, job.choices)
    else:
        sources = HydraConfig.get().runtime.config_sources
        text = help_text(graph, job.choices, [Path(source.path) for source in sources if source.schema == "file"])
    return 0 if say(text) else FAILED


def resumed_job(arguments: Sequence[str]) -> Job:
    """What goes on with the run that `resume=DIR` names. Raises GraphError."""
    words = ["inline=true" if word == "--inline" else word for word in arguments]
    folder = Path(next(word for word in words if word.startswith(RESUME)).removeprefix(RESUME))
    overrides = [word for word in words if not word.startswith(RESUME)]
    for word in overrides:
        if word.startswith("-"):
            raise GraphError(f"{word}: {RESUME}{folder} takes slot=choice, slot.parameter=value and --inline only")
    config = resumed_config(folder, overrides)
    for note in leave_out_refused(config):
        say(f"note: {note}")
    return Job(config, overrides, {}, None, resumed=True)


def hydra_arguments(arguments: Sequence[str]) -> list[str]:
    """The command line as Hydra takes it; of a sweep the folder is made.

    Raises GraphError for overrides that name nothing there is, and for a folder that cannot be made.
    """
    words = ["inline=true" if word == "--inline" else word for word in arguments]
    conf = Path(_option(words, "--config-path", "-cp") or CONF).absolute()
    check_launcher(words)
    words = with_named_input(words, choices_of(SLOT, conf))
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    elsewhere = _option(words, "--config-dir", "-cd") or any(word.startswith("hydra.searchpath") for word in overrides)
    prepared = prepare(overrides, conf, all_choices_known=not elsewhere)
    if not {"-m", "--multirun"} & set(words):
        check_single(overrides)
    else:
        if not elsewhere and not any(word.startswith(("hydra/", "--config-name", "-cn")) for word in words):
            check_jobs(overrides, conf)
        prepared += _sweep_folder(overrides, own=conf == CONF)
    return [word for word in words if word not in overrides] + prepared


def _sweep_folder(overrides: Sequence[str], *, own: bool) -> list[str]:
    """What tells Hydra where a sweep's jobs are numbered. own: the configuration is ours; others name a folder."""
    named = named_folder(overrides)
    if any(text.startswith("hydra.sweep.dir=") for text in overrides) or not (named or own):
        return []
    return [f"hydra.sweep.dir={quoted(str(made_folder(named)))}"]


def _option(words: Sequence[str], *names: str) -> str | None:
    for i, word in enumerate(words):
        name, _, value = word.partition("=")
        if name in names:
            return value or (words[i + 1] if i + 1 < len(words) else None)
    return None


if __name__ == "__main__":
    code = main(sys.argv[1:])
    flush(sys.stdout)
    flush(sys.stderr)
    os._exit(
        code
    )  # the interpreter takes seconds to take down libraries of which only the nodes' parameters were asked
