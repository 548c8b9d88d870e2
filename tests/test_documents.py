"""Documents: what they name exists, what is generated equals its generator's output, lines are short enough to read."""

from __future__ import annotations

import re
import shlex
import signal
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from bench import figures, plots, record
from launch import outcome
from launch.compose import choices_of, compose
from launch.refusal import GraphError
from mvsgs.command import COMMANDS
from tests.support.benchmarks import BENCHMARKS
from tests.support.shared_data import ROOT

DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "BENCHMARKS.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")), ROOT / "examples" / "README.md", ROOT / "msgs" / "WIRE.md",
]  # fmt: skip
FOR_PEOPLE = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs" / "guides").glob("*.md"))]
WIDEST, MAX_COLUMNS, LONGEST_PAGE = 120, 8, 150
FOLDERS = ("bench", "docs", "examples", "launch", "msgs", "mvsgs", "mvsgs_core", "nodes", "tests")
GENERATED = re.compile(r"<!-- bench:([\w/.-]+) -->.*?<!-- /bench:\1 -->", re.DOTALL)
EVERY = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: str(document.relative_to(ROOT)))


def by_hand(document: Path) -> str:
    """The text without what is generated: recorded commands are those of their commit."""
    return GENERATED.sub("", document.read_text())


@EVERY
def test_lines_are_as_long_as_a_reader_takes_in(document: Path) -> None:
    code = False
    for number, line in enumerate(document.read_text().splitlines(), 1):
        code ^= line.startswith("```")
        if line.startswith("|"):
            assert line.replace("\\|", "").count("|") - 1 <= MAX_COLUMNS, f"{document.name}:{number}: columns"
        elif not code and not line.startswith("    "):
            assert len(line) <= WIDEST, f"{document.name}:{number}: {len(line)} characters"


def test_the_page_of_figures_is_one_page() -> None:
    assert len(record.DOCUMENT.read_text().splitlines()) <= LONGEST_PAGE


@EVERY
def test_links_lead_to_files(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if not target.startswith(("http", "#")):
            assert (document.parent / target.partition("#")[0]).exists(), f"{document.name}: {target}"


@EVERY
def test_paths_in_code_marks_exist(document: Path) -> None:
    """`mvsgs_core/mapping/` and `launch/run_all.py` do, and every file that is named with its folder."""
    for text in re.findall(r"`([^`\n]+)`", by_hand(document)):
        for path in re.findall(rf"^(?:{'|'.join(FOLDERS)})/[\w./-]*$", text):
            assert "NAME" in path or (ROOT / path).exists(), f"{document.name}: {path}"


@EVERY
def test_modules_that_are_run_or_imported_exist(document: Path) -> None:
    text = by_hand(document)
    for module in re.findall(r"python -m ([a-z_][\w.]*\w)", text) + re.findall(r"from ([a-z_][\w.]*) import", text):
        assert module.endswith(".NAME") or find_spec(module) is not None, f"{document.name}: {module}"


@pytest.mark.slow
@EVERY
def test_commands_compose(document: Path) -> None:
    """Every run that a document shows, by launch/run_all.py or mvsgs: its slots, choices and parameters are there."""
    for line in re.findall(r"^ *(?:python \S*launch/run_all\.py|mvsgs) (.+)$", by_hand(document), re.MULTILINE):
        words = re.findall(r'(?:[^\s"]|"[^"]*")+', line.partition("  #")[0])
        overrides = [word.strip('"') for word in words if "=" in word]
        if any(text in line for text in ("resume=", "_target_", "PATH/TO")):
            continue
        try:
            compose(overrides)
        except GraphError as error:
            pytest.fail(f"{document.name}: {line}: {error}")


def source_of(words: list[str]) -> str | None:
    """What reads the options of a command line that a document shows; None for one that maps what it names."""
    if words[0] == "mvsgs":
        known = COMMANDS.get(words[1])
        if known is None:  # an input, or a choice; a setting
            assert re.search(r"[=/.]", words[1]) or words[1] in (*choices_of("dataset"), "rgbd_dataset_freiburg1_xyz")
        if known is None or not known.module:
            return None
        module = known.module
    elif words[1] == "-m":
        module = words[2]
    elif words[1].endswith(".py"):
        return (ROOT / words[1].removeprefix("PATH/TO/REPOSITORY/")).read_text()
    else:
        return None
    found = find_spec(module)
    assert found is not None
    assert found.origin is not None
    file = Path(found.origin)
    return "".join(path.read_text() for path in (file, file.with_name("command_line.py")) if path.exists())


@pytest.mark.parametrize("document", FOR_PEOPLE, ids=lambda document: document.stem)
def test_commands_and_their_options_exist(document: Path) -> None:
    for line in re.findall(r"^ *((?:mvsgs|python) .+)$", by_hand(document).replace("\\\n", " "), re.MULTILINE):
        words = shlex.split(line, comments=True)
        source = source_of(words)
        for option in [word.partition("=")[0] for word in words if word.startswith("--")]:
            assert source is not None and f'"{option}"' in source, f"{document.name}: {line}: {option}"  # noqa: PT018


def test_the_exit_codes_of_the_guide_are_those_of_a_run() -> None:
    text = (ROOT / "docs" / "guides" / "own_video.md").read_text()
    said = re.findall(r"^\| ([\d, ]+) \|", text.partition("| exit code |")[2], re.MULTILINE)
    signals = {outcome.BY_SIGNAL + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    codes = {outcome.DONE, outcome.FAILED, outcome.REFUSED, outcome.NOTHING, outcome.OBSERVER_FAILED} | signals
    assert [int(code) for row in said for code in row.split(", ")] == sorted(codes)


def installed_by_name(text: str) -> Iterator[Requirement]:
    """What it says to install from an index."""
    for quoted, plain in re.findall(r"""pip install (?:["']([^"']+)["']|([A-Za-z][\w-]*\b(?![/*.])))""", text):
        yield Requirement(quoted or plain)


def test_what_is_installed_by_name_is_what_the_extras_ask_for() -> None:
    """And never this by its own name: until it is released, that may be anybody's."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = [Requirement(line) for lines in extras.values() for line in lines]
    sources = [file for folder in FOLDERS if folder != "tests" for file in sorted((ROOT / folder).rglob("*.py"))]
    found = [(file, name) for file in (*DOCUMENTS, *sources) for name in installed_by_name(file.read_text())]
    assert {"ray", "hydra-submitit-launcher", "rosbags"} <= {requirement.name for _, requirement in found}
    for file, requirement in found:
        assert requirement.name != "mvsgs", file.name
        assert not requirement.specifier or requirement in asked, f"{file.name}: {requirement}"


def flat(config: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for key, value in config.items():
        yield f"{prefix}.{key}"
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}.{key}")


@cache
def parameters() -> frozenset[str]:
    """`slot.path` of what the choices have, as far as their nodes' configurations go."""
    compositions = (
        [],
        ["tracker=droid"],
        ["tracker=ground_truth"],
        ["dataset=robot"],
        ["dataset=euroc"],
        ["dataset=ros2"],
        ["mvs=itermvs"],
    )
    slots = [slot for overrides in compositions for slot in compose(list(overrides)).slots.items()]
    return frozenset(name for slot, known in slots for name in flat(known.config, slot))


@pytest.mark.slow
@EVERY
def test_parameters_in_code_marks_exist(document: Path) -> None:
    for name in re.findall(r"`((?:dataset|tracker|mvs|depth_fusion|mapper|evaluator)\.[a-z_.]+)\b", by_hand(document)):
        launcher = name.split(".")[1] in ("cpu", "_target_", "external")
        own = document.parent.name == "examples"  # of a node of the reader's own
        assert launcher or own or name in parameters(), f"{document.name}: {name}"


def test_every_benchmark_has_its_page_and_every_page_what_is_recorded() -> None:
    assert [page.stem for page in sorted(record.PAGES.glob("*.md"))] == BENCHMARKS
    for document in record.documents():
        text = document.read_text()
        names = set(re.findall(r"<!-- bench:(\S+) -->", text))
        own = {record.DOCUMENT: "figures", record.README: "first"}.get(document)
        assert names == {own or document.stem}
        assert record.render(text) == text, f"{document.name} differs from what is recorded: python -m bench.record"
        if own is None:
            assert f"python -m bench.{document.stem}" in by_hand(document)


def test_the_plots_are_of_what_is_recorded(tmp_path: Path) -> None:
    for name, svg in figures.plots_of(lambda of: record.Record.load(of).rows).items():
        plots.write(tmp_path / f"{name}.svg", svg)
        drawn = (record.PAGES / f"{name}.svg").read_text()
        assert (tmp_path / f"{name}.svg").read_text() == drawn, f"{name}.svg is old: python -m bench.record"
