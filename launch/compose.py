"""Command-line overrides -> configuration (Hydra) -> checked graph.

A choice's file holds only what differs from the defaults of the node's `Config`, which decides what parameters there
are. Hydra would refuse one that the file does not have, so it is given `++slot.parameter=value`.
"""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from launch.graph import Graph, Replaced, build_graph
from launch.named_input import quoted
from launch.refusal import GraphError
from launch.settings import Settings
from launch.settings_file import absolute
from nodes.parameters import did_you_mean, parameter_names, plain_values

CONF = Path(__file__).resolve().parent / "conf"
DEFAULTS = plain_values(Settings())  # so that a choice's file can name any of the keys of no slot: ${output}


def compose(overrides: Sequence[str] = (), conf: Path = CONF) -> Graph:
    """The graph of the configuration in `conf` with overrides such as "dataset=tum" or "mapper.iterations=9".

    Raises GraphError, before anything runs, with what would be valid.
    """
    prepared = prepare(overrides, conf)
    try:
        with _hydra_aside(), initialize_config_dir(version_base="1.3", config_dir=str(conf)):
            config = hydra_compose("config", prepared, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise GraphError(str(error)) from error
    return graph_of(config, prepared, config.hydra.runtime.choices)


@contextmanager
def _hydra_aside() -> Iterator[None]:
    """Hydra is initialized once in a process: where the program that maps has done so, it finds it as it was."""
    theirs, base = GlobalHydra.instance(), VersionBase.instance()
    hydra, version = theirs.hydra, base.getbase()
    theirs.clear()
    try:
        yield
    finally:
        theirs.hydra, base.version_base = hydra, version
        GlobalHydra.set_instance(theirs)


def graph_of(config: DictConfig, overrides: Sequence[str], choices: Mapping[str, Any]) -> Graph:
    """The graph of a composed configuration. `overrides` are those it was composed with."""
    slots = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    own = OmegaConf.merge(DEFAULTS, slots)
    assert isinstance(own, DictConfig)
    if not isinstance(own.output, str | None):
        raise GraphError(f"output={own.output}: must be the name of a folder; write output=./NAME")
    own.output = own.output or f"runs/{time.strftime('%Y-%m-%d_%H-%M-%S')}-{choices.get('dataset', 'run')}"
    own.output = str(Path(own.output).expanduser().absolute())
    replaced = _replaced(own, overrides)
    try:
        resolved = OmegaConf.to_container(own, resolve=True)
    except OmegaConfBaseException as error:
        raise GraphError(str(error)) from error
    assert isinstance(resolved, dict)
    return build_graph({str(key): _at_home(value) for key, value in resolved.items()}, replaced)


def _at_home(value: Any) -> Any:
    """With ~/ at the beginning of a text as a shell has it, which leaves that alone behind a key and an equals sign."""
    if isinstance(value, dict):
        return {key: _at_home(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_at_home(item) for item in value]
    # os.path's raises nothing where a user has no home
    return os.path.expanduser(value) if isinstance(value, str) and value.startswith("~/") else value  # noqa: PTH111


OmegaConf.register_new_resolver("absolute", lambda path: absolute(_at_home(path)), replace=True)  # ${absolute:PATH}


def prepare(overrides: Sequence[str], conf: Path = CONF, *, all_choices_known: bool = True) -> list[str]:
    """Overrides as Hydra takes them. Raises GraphError for an unknown slot, choice or key, with those there are.

    `all_choices_known` is False where choices can come from other directories: Hydra refuses them then.
    """
    choices = {slot: choices_of(slot, conf) for slot in defaults_of(conf)}
    overrides = [in_grammar(text if "refine" in choices else _spelled_out(text)) for text in overrides]
    overrides = [*_implied(overrides, choices, conf), *overrides]
    return [_prepare(text, choices, parameter_names(Settings), all_choices_known) for text in overrides]


def _spelled_out(text: str) -> str:
    """`refine=ray` and `refine.address=...` as the mapper has them: it is no slot, but is written like one."""
    if text.startswith("refine="):
        return f"mapper.refine.by={text.removeprefix('refine=')}"
    return f"mapper.{text}" if text.startswith("refine.") else text


def _implied(overrides: Sequence[str], slots: Mapping[str, list[str]], conf: Path) -> list[str]:
    """What choices say of other slots, `implies` in their files, where the command line chooses nothing for these."""
    given = {override.key_or_group: override for override in map(parse, overrides)}
    found: dict[str, str] = {}
    for slot, override in given.items():
        if slot in slots and not override.is_sweep_override() and override.value() in slots[slot]:
            implied = choice_of(slot, str(override.value()), conf).get("implies") or {}
            found |= {str(other): str(choice) for other, choice in implied.items()}
    return [f"{slot}={choice}" for slot, choice in found.items() if slot not in given]


def _prepare(text: str, slots: Mapping[str, list[str]], settings: Sequence[str], all_choices_known: bool) -> str:
    override = parse(text)
    key = override.key_or_group
    root, _, rest = key.partition(".")
    if root == "hydra" or root.startswith("hydra/") or override.type is not OverrideType.CHANGE:
        return text
    if key == "output" and isinstance(override.value(), int | float):  # a folder may have such a name
        return f"++output=./{text.partition('=')[2]}"
    if root in settings:
        return f"++{text}"
    if root not in slots:
        raise GraphError(
            f"{text}: no slot or key {root!r}{did_you_mean(root, [*slots, *settings])}; slots: {', '.join(slots)}; "
            f"other keys: {', '.join(settings)}"
        )
    if rest:
        return f"++{text}"
    chosen, choices = override.value(), slots[root]
    if chosen == "external" and chosen not in choices:
        return f"++{root}.external=true"
    if all_choices_known and not override.is_sweep_override() and chosen not in choices:
        raise GraphError(
            f"{text}: {root} has no choice {chosen!r}{did_you_mean(str(chosen), choices)}; "
            f"there are: {', '.join([*choices, 'external'])}"
        )
    return text


def choices_of(slot: str, conf: Path = CONF) -> list[str]:
    """The choices of a slot."""
    return sorted(path.stem for path in (conf / slot).glob("*.yaml"))


def choice_of(slot: str, choice: str, conf: Path = CONF) -> DictConfig:
    """What the file of one of them says."""
    content = OmegaConf.load(conf / slot / f"{choice}.yaml")
    assert isinstance(content, DictConfig)
    return content


def defaults_of(conf: Path = CONF) -> dict[str, str]:
    """The slots that config.yaml names, each with its choice there."""
    config = OmegaConf.load(conf / "config.yaml")
    assert isinstance(config, DictConfig)
    entries = [entry for entry in config.defaults if isinstance(entry, DictConfig)]
    found = {str(slot): str(choice) for entry in entries for slot, choice in entry.items()}
    return {slot: choice for slot, choice in found.items() if not slot.startswith("override ")}


def _replaced(config: DictConfig, overrides: Sequence[str]) -> dict[str, Replaced]:
    """The slots whose `_target_` the overrides give, with the parameters that are not left from the old choice."""
    given: dict[str, set[str]] = {}
    for override in map(parse, overrides):
        root, _, rest = override.key_or_group.partition(".")
        if rest:
            given.setdefault(root, set()).add(rest.split(".")[0])
    replaced = {}
    for slot, keys in given.items():
        if "_target_" in keys and slot in config:
            interpolated = [str(key) for key in config[slot] if OmegaConf.is_interpolation(config[slot], str(key))]
            replaced[slot] = Replaced(sorted(keys), interpolated)
    return replaced


def parse(text: str) -> Override:
    """One override, as `in_grammar` has it. Raises GraphError for what is none."""
    try:
        return OverridesParser.create().parse_override(in_grammar(text))
    except HydraException as error:
        hint = f"; as a text: {_typed(_in_quotes(text))}" if _parses(_in_quotes(text)) else ""
        raise GraphError(f"{text}: must look like slot=choice or slot.parameter=value ({error}){hint}") from error


def in_grammar(text: str) -> str:
    """An override whose value is outside of Hydra's grammar, as a path with an umlaut, a "(" or a "=", with that value
    in quotes; as it is where it can be something else: the beginning of a list or text, an interpolation, a sweep."""
    value = text.partition("=")[2]
    if _parses(text) or value.startswith(("'", '"', "[", "{")) or "," in value or "${" in value:
        return text
    return _in_quotes(text) if _parses(_in_quotes(text)) else text


def _in_quotes(text: str) -> str:
    key, separator, value = text.partition("=")
    return f"{key}{separator}{quoted(value)}" if separator else text


def _typed(text: str) -> str:
    """In a shell."""
    return shlex.quote(text) if set('"$`\\!') & set(text) else f'"{text}"'


def _parses(text: str) -> bool:
    try:
        OverridesParser.create().parse_override(text)
    except HydraException:
        return False
    return True
