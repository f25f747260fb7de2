"""Turns plain values into frozen dataclasses, strictly: unknown keys and wrong types are errors of one line."""

from __future__ import annotations

import types
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints


class ConfigError(Exception):
    """The configuration is wrong; the message names the key and what would be right."""


@cache
def hints(cls: type) -> dict[str, Any]:
    """Resolved type hints of a dataclass."""
    return get_type_hints(cls)


def nearest(word: str, choices: list[str]) -> str:
    """A hint such as "; did you mean 'lr'?", or the list when it is short, or nothing."""
    close = get_close_matches(word, choices, n=1, cutoff=0.5)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; there are {', '.join(sorted(choices))}" if choices and len(choices) <= 12 else ""


def defaults(cls: type) -> dict[str, Any]:
    """Default values of a dataclass as plain values; fields without a default are left out."""
    out: dict[str, Any] = {}
    for f in fields(cls):
        if f.default is not MISSING:
            out[f.name] = _plain(f.default)
        elif f.default_factory is not MISSING:
            out[f.name] = _plain(f.default_factory())
        else:
            hint = hints(cls)[f.name]
            if is_dataclass(hint) and isinstance(hint, type):
                out[f.name] = defaults(hint)
    return out


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, Path) else value


def convert(hint: Any, value: Any, where: str = "") -> Any:
    """Return `value` as an instance of `hint`.

    Args:
        hint: a dataclass or another type annotation.
        value: plain values as YAML gives them.
        where: dotted key, for messages.

    Raises:
        ConfigError: unknown key, missing key, wrong type, or a value that the dataclass refuses.
    """
    if isinstance(hint, type) and is_dataclass(hint):
        return _convert_dataclass(hint, value, where)
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, where, hint)
    if origin is Literal:
        for choice in args:
            if type(choice) is type(value) and choice == value:
                return value
        raise ConfigError(f"{where}={_show(value)}: choose one of {', '.join(map(str, args))}")
    if origin in (tuple, list):
        return _convert_sequence(origin, args, value, where)
    if origin is dict:
        if not isinstance(value, dict):
            raise _wrong(where, "a mapping", value)
        return {convert(args[0], k, where): convert(args[1], v, f"{where}.{k}") for k, v in value.items()}
    if isinstance(hint, type) and issubclass(hint, Enum):
        try:
            return hint(value)
        except ValueError:
            choices = ", ".join(str(member.value) for member in hint)
            raise ConfigError(f"{where}={_show(value)}: choose one of {choices}") from None
    return _convert_scalar(hint, value, where)


def _convert_dataclass(cls: type, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _wrong(where, "a mapping", value)
    known = hints(cls)
    for name in value:
        if name not in known:
            raise ConfigError(f"unknown key '{_join(where, name)}'{nearest(str(name), list(known))}")
    for f in fields(cls):
        if f.name not in value and f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(f"{_join(where, f.name)} is not set; add {_join(where, f.name)}=VALUE")
    kwargs = {name: convert(known[name], item, _join(where, name)) for name, item in value.items()}
    try:
        return cls(**kwargs)
    except ValueError as error:
        text = str(error)
        named = not where or text.startswith((f"{where}.", f"{where}:"))
        raise ConfigError(text if named else f"{where}: {text}") from error


def _convert_union(args: tuple[Any, ...], value: Any, where: str, hint: Any) -> Any:
    if value is None and type(None) in args:
        return None
    error: ConfigError | None = None
    for arg in args:
        if arg is not type(None):
            try:
                return convert(arg, value, where)
            except ConfigError as caught:
                error = caught
    if error is not None and len([a for a in args if a is not type(None)]) == 1:
        raise error
    raise _wrong(where, str(hint), value)


def _convert_sequence(origin: Any, args: tuple[Any, ...], value: Any, where: str) -> Any:
    if not isinstance(value, (list, tuple)):
        raise _wrong(where, "a list", value)
    if origin is list or (len(args) == 2 and args[1] is Ellipsis):
        return origin(convert(args[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if len(args) != len(value):
        raise ConfigError(f"{where}={_show(value)}: needs {len(args)} values, got {len(value)}")
    return tuple(convert(a, item, f"{where}[{i}]") for i, (a, item) in enumerate(zip(args, value, strict=True)))


def _convert_scalar(hint: Any, value: Any, where: str) -> Any:
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is str and isinstance(value, (str, int, float)) and not isinstance(value, bool):
        return str(value)
    if hint is bool and isinstance(value, bool):
        return value
    if hint is Path and isinstance(value, str):
        return Path(value)
    names = {float: "a number", int: "an integer", str: "text", bool: "true or false", Path: "a path"}
    raise _wrong(where, names.get(hint, str(hint)), value)


def _join(where: str, name: object) -> str:
    return f"{where}.{name}" if where else str(name)


def _show(value: Any) -> str:
    return "null" if value is None else str(value)


def _wrong(where: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"{where}={_show(value)}: must be {wanted}, not {type(value).__name__}")
