"""Reads the facts from which the robot is built: published numbers of the parts, and how they make one robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from wbm.robot.rotations import unit_quat

STANDARD = ("facts.yaml", "platform.yaml")
"""Beside this file: the published numbers, and this project's own choices. A user's file is laid over both."""

MAX_BYTES = 1 << 20
_MISSING = object()


class FactsError(ValueError):
    """Facts that make no robot; the message names the file, the field and what it should be."""


@dataclass(frozen=True)
class Entry:
    """A value of a facts file that knows its place, so that every complaint names the field."""

    value: Any
    file: str
    place: str = ""

    def error(self, reason: str) -> FactsError:
        """What to raise about this entry."""
        return FactsError(f"{self.file}: {self.place or 'the file'}: {reason}")

    def get(self, key: str) -> Entry | None:
        """The entry below `key`, or None; the entry itself must be a mapping."""
        if not isinstance(self.value, dict):
            raise self.error("must be a mapping")
        found = self.value.get(key, _MISSING)
        if found is _MISSING or found is None:
            return None
        return Entry(found, self.file, f"{self.place}.{key}" if self.place else key)

    def __getitem__(self, key: str) -> Entry:
        found = self.get(key)
        if found is None:
            raise self.error(f"{key} is missing")
        return found

    def items(self) -> Iterator[tuple[str, Entry]]:
        """Keys and entries of a mapping."""
        if not isinstance(self.value, dict):
            raise self.error("must be a mapping")
        return ((str(key), self[key]) for key in self.value)

    def each(self) -> list[Entry]:
        """Entries of a list."""
        if not isinstance(self.value, list):
            raise self.error("must be a list")
        return [Entry(item, self.file, f"{self.place}[{i}]") for i, item in enumerate(self.value)]

    def word(self) -> str:
        """A name."""
        if not isinstance(self.value, str) or not self.value:
            raise self.error("must be a name")
        return self.value

    def number(self, above: float = -np.inf) -> float:
        """A finite number greater than `above`; text that spells one will do, as in MJCF."""
        try:
            value = float(self.value)
        except (TypeError, ValueError):
            raise self.error("must be a number") from None
        if not np.isfinite(value) or not value > above:
            raise self.error("must be a finite number" + (f" above {above:g}" if np.isfinite(above) else ""))
        return value

    def vector(self, count: int) -> np.ndarray:
        """Finite numbers [count]: a list, text with spaces as in MJCF, or a lone number."""
        items = self.value.split() if isinstance(self.value, str) else self.value
        try:
            vector = np.atleast_1d(np.array(items, dtype=np.float64))
        except (TypeError, ValueError):
            vector = np.empty(0)
        if vector.shape != (count,) or not np.isfinite(vector).all():
            raise self.error(f"must be {count} finite numbers")
        return vector

    def quat(self) -> np.ndarray:
        """A rotation [4] (w x y z), scaled to unit length."""
        vector = self.vector(4)
        if np.linalg.norm(vector) < 1e-6:
            raise self.error("must be a quaternion w x y z that is not zero")
        return unit_quat(vector)


def read_facts(path: str | Path) -> bytes:
    """The bytes of a user's facts file.

    Raises:
        OSError: the file cannot be read.
        FactsError: it is larger than any facts file.
    """
    place = Path(path).expanduser()
    if place.stat().st_size > MAX_BYTES:
        raise FactsError(f"{path}: larger than {MAX_BYTES >> 20} MB, which no facts file is")
    return place.read_bytes()


def parse_facts(own: bytes = b"", file: str = "wbm's own facts") -> Entry:
    """The standard facts, with a user's laid over them: mappings key by key, parts and lists as a whole.

    Args:
        own: YAML; nothing leaves the standard facts as they are.
        file: what errors call it.

    Raises:
        FactsError: no YAML mapping, or a section that is unknown.
    """
    standard = _standard()
    if not own:
        return Entry(standard, file)
    try:
        changes = _parse(own)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise FactsError(f"{file}: is not YAML ({' '.join(str(error).split())[:160]})") from None
    if not isinstance(changes, dict):
        raise FactsError(f"{file}: must be a mapping with sections such as parts, mounts or joints")
    entry = Entry(_laid_over(standard, changes), file)
    named = {part.word() for _, part in entry["parts"].items()}
    for key in changes:
        if key not in standard and key not in named:
            raise FactsError(f"{file}: {key}: is no section, and no group of `parts` is made of it")
    return entry


def _laid_over(base: Any, own: Any) -> Any:
    if not (isinstance(base, dict) and isinstance(own, dict)):
        return own
    # A mapping with `bodies` is a part: it replaces the published one as a whole.
    if "bodies" in own:
        return own
    return base | {key: _laid_over(base[key], value) if key in base else value for key, value in own.items()}


def _parse(data: bytes) -> Any:
    return yaml.load(data, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def standard_text() -> str:
    """The standard facts as the YAML that they are read from, with comments."""
    return "\n".join(Path(__file__).with_name(name).read_text(encoding="utf-8") for name in STANDARD)


@cache
def _standard() -> dict[str, Any]:
    return _parse(standard_text().encode())
