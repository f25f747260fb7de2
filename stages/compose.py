"""The only file that imports Hydra: composes `conf/` and overrides into one frozen `Config`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, cast, get_args, get_origin

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from stages.config import Config
from stages.convert import ConfigError, convert, defaults, hints, nearest

CONFIG_NAME = "config"


@dataclass(frozen=True)
class Composed:
    """A resolved configuration.

    Attributes:
        config: the typed tree.
        overrides: what was asked for on the command line.
        choices: group -> chosen preset.
    """

    config: Config
    overrides: tuple[str, ...]
    choices: dict[str, str]


def conf_dir() -> Path:
    """Folder with the YAML: beside `stages/` in a checkout, inside it in a wheel.

    Raises:
        ConfigError: an incomplete installation.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / f"{CONFIG_NAME}.yaml").is_file():
            return folder
    raise ConfigError(f"conf/{CONFIG_NAME}.yaml is missing beside {here}; install wbm again")


def register() -> None:
    """Make the dataclass defaults known to Hydra as the config `schema`."""
    ConfigStore.instance().store(name="schema", node=defaults(Config))


def _start() -> Any:
    state = GlobalHydra.instance()
    if not state.is_initialized():
        register()
        initialize_config_dir(config_dir=str(conf_dir()), version_base="1.3")
    assert state.hydra is not None
    return state.hydra.config_loader


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parse override lines.

    Raises:
        ConfigError: not in Hydra's grammar.
    """
    loader = _start()
    parser = OverridesParser.create(config_loader=loader)
    parsed = []
    for line in overrides:
        try:
            parsed += parser.parse_overrides([line])
        except HydraException as error:
            raise ConfigError(f"cannot read override '{line}'; write key=value, without spaces") from error
    return parsed


def compose(overrides: Sequence[str] = ()) -> Composed:
    """Compose the configuration.

    Args:
        overrides: lines in Hydra's override grammar, without sweeps.

    Raises:
        ConfigError: one line that names the key and the nearest valid one.
    """
    return _compose(tuple(overrides))


@lru_cache(maxsize=256)
def _compose(overrides: tuple[str, ...]) -> Composed:
    cfg = _compose_raw(overrides)
    choices = {str(k): str(v) for k, v in cfg.hydra.runtime.choices.items() if not str(k).startswith("hydra/")}
    return Composed(build(cfg), overrides, choices)


def _compose_raw(overrides: Sequence[str]) -> DictConfig:
    items = parse(overrides)
    for item in items:
        _check_override(item)
    # An entry of a mapping, such as inputs.assets=NAME, is new to Hydra, which would ask for a plus sign.
    added = [_is_entry(item) and not (item.is_add() or item.is_force_add() or item.is_delete()) for item in items]
    lines = [f"++{line}" if new else line for new, line in zip(added, overrides, strict=True)]
    try:
        return hydra_compose(CONFIG_NAME, overrides=lines, return_hydra_config=True)
    except Exception as error:  # Hydra raises whatever its parts raise, AssertionError and TypeError among them
        raise ConfigError(_one_line(error)) from error


def build(cfg: DictConfig) -> Config:
    """Resolve interpolations and build the typed tree.

    Raises:
        ConfigError: as `compose`.
    """
    try:
        own = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
        values = cast("dict[str, Any]", OmegaConf.to_container(own, resolve=True, throw_on_missing=True))
    except (OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_one_line(error)) from error
    return convert(Config, values)


def _check_override(item: Override) -> None:
    key = item.key_or_group
    if item.is_sweep_override():
        raise ConfigError(f"{item.input_line}: several values; add -m to run them all")
    if key.startswith("hydra.") or key.startswith("hydra/"):
        raise ConfigError(f"{key}: Hydra's own settings have no effect here; set artifacts.root=DIR for the output")
    if not key:
        raise ConfigError(f"{item.input_line}: names no key; write key=value")
    options = presets(key)
    if options:
        value = item.value()
        if not isinstance(value, dict) and value not in options and not item.is_delete():
            raise ConfigError(f"{key}={value}: no such preset{nearest(str(value), list(options))}")
        return
    hint: Any = Config
    walked: list[str] = []
    for part in key.split("."):
        if hint is Any or not (isinstance(hint, type) and is_dataclass(hint)):
            args = get_args(hint)
            hint = args[-1] if args else None
            if hint is None:
                raise ConfigError(f"unknown key '{key}': {'.'.join(walked)} is a value, not a section")
            continue
        known = hints(hint)
        if part not in known:
            words = [".".join([*walked, name]) for name in (known if walked else [*known, *groups()])]
            raise ConfigError(f"unknown key '{key}'{nearest('.'.join([*walked, part]), words)}")
        hint = known[part]
        walked.append(part)


def _is_entry(item: Override) -> bool:
    """Whether an override sets an entry of a field that is a mapping."""
    hint: Any = Config
    for part in item.key_or_group.split("."):
        if get_origin(hint) is dict:
            return True
        hint = hints(hint).get(part) if isinstance(hint, type) and is_dataclass(hint) else None
    return False


def _one_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return re.sub(r"\s+", " ", " ".join(lines[:2])) or type(error).__name__


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """Expand `a,b`, `range()` and globs of a sweep into override lists, in Hydra's order.

    Raises:
        ConfigError: not in Hydra's grammar, or a sweep that has no end (interval).
    """
    loader = _start()
    parsed = parse(overrides)
    for item in parsed:
        item.config_loader = loader
    try:
        return BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]
    except HydraException as error:
        raise ConfigError(_one_line(error)) from error


def swept_keys(overrides: Sequence[str]) -> list[str]:
    """Keys or groups that take several values in a sweep."""
    return [item.key_or_group for item in parse(overrides) if item.is_sweep_override()]


@cache
def presets(group: str) -> tuple[str, ...]:
    """Names of the presets of a group, empty when there is no such group."""
    return tuple(_start().get_group_options(group))


@cache
def groups() -> tuple[str, ...]:
    """Names of all groups."""
    return tuple(name for name in _start().list_groups("") if name != "hydra")


def all_keys() -> list[str]:
    """All dotted keys of the configuration."""

    def walk(cls: Any, prefix: str) -> list[str]:
        out: list[str] = []
        for f in fields(cls):
            hint = hints(cls)[f.name]
            nested = isinstance(hint, type) and is_dataclass(hint)
            out += walk(hint, f"{prefix}{f.name}.") if nested else [f"{prefix}{f.name}"]
        return out

    return walk(Config, "")


def to_yaml(values: Any) -> str:
    """YAML text of plain values."""
    return OmegaConf.to_yaml(OmegaConf.create(values))


def defaults_list(overrides: Sequence[str]) -> str:
    """The defaults list: one line for each YAML file, in the order of merging."""
    loader = _start()
    listing = loader.compute_defaults_list(config_name=CONFIG_NAME, overrides=list(overrides), run_mode=_run_mode())
    rows = [
        f"{d.config_path or ''}{' -> ' + d.package if d.package else ''}"
        for d in listing.defaults
        if not (d.config_path or "").startswith("hydra")
    ]
    return "\n".join(rows)


def _run_mode() -> Any:
    from hydra.types import RunMode

    return RunMode.RUN
