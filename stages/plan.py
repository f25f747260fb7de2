"""The plan: which artifacts a configuration asks for, which are there, and why the others are not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from stages.code import Code, code_of
from stages.config import Config
from stages.convert import ConfigError
from stages.registry import Stage
from wbm.artifacts.digest import digest_value, plain
from wbm.artifacts.manifest import InputRef, Manifest
from wbm.artifacts.store import Store

_MAX_REASONS = 4


class SectionView:
    """The sections that a stage declared. Reading another one is an error: the key would not cover it."""

    def __init__(self, config: Config, stage: Stage) -> None:
        self._config = config
        self._stage = stage

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._stage.sections:
            raise AttributeError(
                f"stage {self._stage.name} reads section '{name}'; add it to SECTIONS in {self._stage.module}"
            )
        return getattr(self._config, name)


@dataclass
class Node:
    """One artifact to be: a stage under a configuration.

    Attributes:
        inputs: slot -> manifest of the input; None when it is still to be made.
        key: None while an input is missing.
        done: manifest of the artifact when it is published under `key`.
        reasons: why it must run; empty when it is up to date.
    """

    stage: Stage
    config: Config
    overrides: tuple[str, ...]
    kind: str
    name: str
    code: Code
    sections: dict[str, Any]
    upstream: dict[str, Node] = field(default_factory=dict)
    fixed: dict[str, Manifest] = field(default_factory=dict)
    inputs: dict[str, Manifest | None] = field(default_factory=dict)
    key: str | None = None
    done: Manifest | None = None
    reasons: list[str] = field(default_factory=list)

    @property
    def ref(self) -> str:
        """`kind/name`."""
        return f"{self.kind}/{self.name}"

    @property
    def stale(self) -> bool:
        """Whether the stage must run."""
        return self.done is None

    @property
    def view(self) -> SectionView:
        """What the stage may read."""
        return SectionView(self.config, self.stage)

    def manifest(self) -> Manifest:
        """What is known before the stage runs.

        Raises:
            ValueError: an input is missing.
        """
        if self.key is None:
            raise ValueError(f"{self.ref}: inputs are missing")
        return Manifest(
            kind=self.kind,
            name=self.name,
            key=self.key,
            stage=self.stage.name,
            config=self.sections,
            inputs={slot: InputRef(m.ref, m.content_digest) for slot, m in self.inputs.items() if m},
            code=self.code.files,
            code_digest=self.code.digest,
            versions=self.code.versions,
            seeds={"seed": self.config.seed},
            note=self.config.note,
        )


Composer = Callable[[Sequence[str]], Config]


@cache
def _code(module: str) -> Code:
    return code_of(module)


def build(stages: Sequence[Stage], overrides: Sequence[str], composer: Composer, store: Store) -> list[Node]:
    """All nodes of the pipeline in order, not yet looked up in the store.

    Args:
        stages: in pipeline order.
        overrides: override lines without sweeps.
        composer: turns override lines into a configuration.
        store: where explicitly named inputs are found.

    Raises:
        ConfigError: a bad configuration.
        ArtifactError: an input that was named does not exist.
    """
    base = composer(overrides)
    nodes: list[Node] = []
    for stage in stages:
        for config, extra in _variants(stage, base, overrides, composer):
            nodes.append(_node(stage, config, (*overrides, *extra), nodes, store))
    return nodes


def _variants(
    stage: Stage, base: Config, overrides: Sequence[str], composer: Composer
) -> list[tuple[Config, tuple[str, ...]]]:
    if stage.each is None:
        return [(base, ())]
    group, suite = stage.each
    for line in overrides:
        if line.lstrip("+").split("=")[0] == group:
            raise ConfigError(f"{line}: the pipeline runs the whole suite; write {suite}=[{line.split('=', 1)[-1]}]")
    entries = getattr(base, suite)
    return [(composer([*overrides, f"{group}={entry}"]), (f"{group}={entry}",)) for entry in entries]


def single(
    stage: Stage, stages: Sequence[Stage], overrides: Sequence[str], composer: Composer, store: Store
) -> list[Node]:
    """Nodes of one stage and of what it needs; the stage's own node is the last.

    Arguments and errors as `build`.
    """
    before = list(stages[: [s.name for s in stages].index(stage.name)])
    shared = [line for line in overrides if not _belongs(line, before)]
    nodes = build(before, shared, composer, store)
    nodes.append(_node(stage, composer(overrides), tuple(overrides), nodes, store))
    return _needed(nodes)


def _belongs(line: str, stages: Sequence[Stage]) -> bool:
    """Whether an override picks one entry of a suite that an earlier stage runs through as a whole."""
    return any(stage.each and line.lstrip("+").split("=")[0] == stage.each[0] for stage in stages)


def _needed(nodes: list[Node]) -> list[Node]:
    wanted: set[int] = set()

    def visit(node: Node) -> None:
        if id(node) not in wanted:
            wanted.add(id(node))
            for upstream in node.upstream.values():
                visit(upstream)

    visit(nodes[-1])
    return [node for node in nodes if id(node) in wanted]


def make_node(stage: Stage, config: Config, overrides: Sequence[str] = (), name: str | None = None) -> Node:
    """A stage under a configuration, without inputs yet; `name` in place of the stage's own name for its artifact."""
    sections = {name: plain(getattr(config, name), key_only=True) for name in stage.sections}
    name = name or stage.artifact_name(SectionView(config, stage))
    return Node(stage, config, tuple(overrides), stage.kind, name, _code(stage.module), sections)


def _node(stage: Stage, config: Config, overrides: tuple[str, ...], before: list[Node], store: Store) -> Node:
    node = make_node(stage, config, overrides)
    for slot in stage.slots:
        text = config.inputs.get(slot.name) or (getattr(config, slot.name, None) if slot.name == "policy" else None)
        if text:
            node.fixed[slot.name] = store.manifest(text)
            continue
        matches = [other for other in before if other.kind == slot.kind]
        for other in matches:
            node.upstream[other.ref if slot.every else slot.name] = other
        if not matches:
            raise ConfigError(f"{stage.name}: no stage makes its input '{slot.name}'; set inputs.{slot.name}=KIND/NAME")
    return node


def compute_key(node: Node) -> str:
    """Digest of the settings read, the code, the contents of the inputs and the locked versions."""
    inputs = {slot: m.content_digest for slot, m in node.inputs.items() if m}
    return digest_value([node.stage.name, node.sections, node.code.digest, inputs, node.code.versions])


def look_up(node: Node, store: Store, *, use_latest: bool = False) -> None:
    """Fill `inputs`, `key`, `done` and `reasons` from what is published now.

    Args:
        node: its upstream nodes have been looked up before.
        store: where to look.
        use_latest: take the newest artifact of a stale input in its place.
    """
    node.inputs = dict(node.fixed)
    for slot, upstream in node.upstream.items():
        newest = store.latest(upstream.kind, upstream.name) if use_latest and upstream.stale else None
        node.inputs[slot] = upstream.done or newest
    missing = [slot for slot, manifest in node.inputs.items() if manifest is None]
    if missing:
        node.key, node.done = None, None
        node.reasons = explain(node, store.latest(node.kind, node.name), missing)
        return
    node.key = compute_key(node)
    node.done = store.find(node.kind, node.name, node.key)
    node.reasons = [] if node.done else explain(node, store.latest(node.kind, node.name), [])


def explain(node: Node, old: Manifest | None, missing: Sequence[str]) -> list[str]:
    """Why `old`, the newest artifact of this name, does not do."""
    if old is None:
        return ["nothing published yet"]
    reasons = diff_values(old.config, node.sections)
    reasons += [f"code of {path} {what}" for path, what in _changes(old.code, node.code.files)]
    reasons += [f"{name} {old.versions.get(name, 'absent')} -> {node.code.versions.get(name, 'absent')}"
                for name, _ in _changes(old.versions, node.code.versions)]  # fmt: skip
    for slot in sorted(set(old.inputs) | set(node.inputs)):
        new = node.inputs.get(slot)
        if slot in missing:
            reasons.append(f"input {slot} changed")
        elif slot not in node.inputs:
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


def plan(nodes: Sequence[Node], store: Store) -> list[Node]:
    """Look every node up, in order, without running anything."""
    for node in nodes:
        look_up(node, store)
    return list(nodes)
