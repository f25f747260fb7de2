"""Why a stage must run, in words: what differs between the newest artifact and what is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stages.code import Code
from wbm.artifacts.manifest import Manifest

_MAX_REASONS = 4


def explain(
    old: Manifest | None,
    sections: dict[str, Any],
    code: Code,
    inputs: Mapping[str, Manifest | None],
    missing: Sequence[str],
) -> list[str]:
    """Why `old`, the newest artifact of a name, does not do.

    Args:
        old: None when there is none.
        sections: the settings that the stage reads now.
        code: the code that it would run now.
        inputs: slot -> input now; None when it is still to be made.
        missing: slots whose input is still to be made.
    """
    if old is None:
        return ["nothing published yet"]
    reasons = diff_values(old.config, sections)
    reasons += [f"code of {path} {what}" for path, what in _changes(old.code, code.files)]
    reasons += [f"{name} {old.versions.get(name, 'absent')} -> {code.versions.get(name, 'absent')}"
                for name, _ in _changes(old.versions, code.versions)]  # fmt: skip
    for slot in sorted(set(old.inputs) | set(inputs)):
        new = inputs.get(slot)
        if slot in missing:
            reasons.append(f"input {slot} changed")
        elif slot not in inputs:
            reasons.append(f"input {slot} is no longer used")
        elif slot not in old.inputs:
            reasons.append(f"input {slot} is new")
        elif new and new.content_digest != old.inputs[slot].content_digest:
            reasons.append(f"input {slot} changed")
    return reasons or ["the newest artifact was made by another stage"]


def _changes(old: dict[str, str], new: dict[str, str]) -> list[tuple[str, str]]:
    out = []
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            out.append((name, "changed" if name in old and name in new else "added" if name in new else "removed"))
    return out


def diff_values(old: Any, new: Any, where: str = "") -> list[str]:
    """Differences of two trees of plain values as `key old -> new`."""
    if isinstance(old, dict) and isinstance(new, dict):
        out = []
        for name in sorted(old.keys() | new.keys()):
            path = f"{where}.{name}" if where else name
            if name not in old or name not in new:
                side = f"absent -> {_show(new[name])}" if name in new else f"{_show(old[name])} -> absent"
                out.append(f"{path} {side}")
            else:
                out += diff_values(old[name], new[name], path)
        return out
    return [] if old == new else [f"{where} {_show(old)} -> {_show(new)}"]


def _show(value: Any) -> str:
    text = "null" if value is None else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def because(reasons: Sequence[str]) -> str:
    """Reasons in one line."""
    more = len(reasons) - _MAX_REASONS
    shown = [f"because {reason}" for reason in reasons[:_MAX_REASONS]]
    return ", ".join(shown) + (f", and {more} more" if more > 0 else "")
