"""The plan: which artifacts a configuration asks for, which are there, and why the others are not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from stages.code import Code, code_of
from stages.config import Config
from stages.convert import ConfigError, nearest
from stages.reasons import explain
from stages.registry import Slot, Stage, load_all
from wbm.artifacts.digest import digest_value, plain
from wbm.artifacts.manifest import InputRef, Manifest
from wbm.artifacts.reference import is_reference
from wbm.artifacts.store import KINDS, Store

POLICIES = ("student", "teacher", "bundle")  # what can be evaluated
_LONG = ("assets", "teacher", "rollouts", "student")  # kinds that reference results stand in for in a whole run


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


def build(
    stages: Sequence[Stage], overrides: Sequence[str], composer: Composer, store: Store, *, reference: bool = False
) -> list[Node]:
    """All nodes of the pipeline in order, not yet looked up in the store.

    Args:
        stages: in pipeline order.
        overrides: override lines without sweeps.
        composer: turns override lines into a configuration.
        store: where explicitly named inputs are found.
        reference: let reference results stand in for what is made by the long stages; what nobody needs then is left
            out. The last of `stages`, the evaluation and the export are run in any case.

    Raises:
        ConfigError: a bad configuration.
        ArtifactError: an input that was named does not exist.
    """
    nodes = _chain(stages, overrides, composer, store, _LONG if reference else ())
    if not reference:
        return nodes
    return _needed(nodes, [n for n in nodes if n.kind not in _LONG or n.stage.name == stages[-1].name])


def _chain(
    stages: Sequence[Stage], overrides: Sequence[str], composer: Composer, store: Store, stand_in: Sequence[str]
) -> list[Node]:
    base = composer(overrides)
    _check_slots(base)
    nodes: list[Node] = []
    for stage in stages:
        for config, extra in _variants(stage, base, overrides, composer):
            nodes.append(_node(stage, config, (*overrides, *extra), nodes, store, stand_in))
    return nodes


def _check_slots(config: Config) -> None:
    """An input that no stage has is a slip of the pen."""
    stages = load_all()
    suites = {stage.kind: getattr(config, stage.each[1]) for stage in stages if stage.each}
    known: set[str] = set()
    for slot in (slot for stage in stages for slot in stage.slots):
        known |= {f"{slot.kind}_{entry}" for entry in suites.get(slot.kind, ())} if slot.every else {slot.name}
    for name in config.inputs:
        if name not in known:
            raise ConfigError(f"inputs.{name}: no stage has this input{nearest(name, sorted(known))}")


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
    stage: Stage,
    stages: Sequence[Stage],
    overrides: Sequence[str],
    composer: Composer,
    store: Store,
    *,
    reference: bool = False,
) -> list[Node]:
    """Nodes of one stage and of what it needs; the stage's own node is the last.

    Arguments and errors as `build`.
    """
    before = list(stages[: [s.name for s in stages].index(stage.name)])
    shared = [line for line in overrides if not _belongs(line, before)]
    stand_in = KINDS if reference else ()
    nodes = _chain(before, shared, composer, store, stand_in)
    nodes.append(_node(stage, composer(overrides), tuple(overrides), nodes, store, stand_in))
    return _needed(nodes, nodes[-1:])


def _belongs(line: str, stages: Sequence[Stage]) -> bool:
    """Whether an override picks one entry of a suite that an earlier stage runs through as a whole."""
    return any(stage.each and line.lstrip("+").split("=")[0] == stage.each[0] for stage in stages)


def _needed(nodes: list[Node], targets: Sequence[Node]) -> list[Node]:
    wanted: set[int] = set()

    def visit(node: Node) -> None:
        if id(node) not in wanted:
            wanted.add(id(node))
            for upstream in node.upstream.values():
                visit(upstream)

    for target in targets:
        visit(target)
    return [node for node in nodes if id(node) in wanted]


def _node(
    stage: Stage,
    config: Config,
    overrides: tuple[str, ...],
    before: list[Node],
    store: Store,
    stand_in: Sequence[str],
) -> Node:
    """One node, its inputs either fixed to published artifacts or tied to the nodes before it.

    `stand_in` lists the kinds of inputs that are taken from the reference results where they have one.
    """
    node = bare_node(stage, config, overrides)
    asked = {slot.name: _asked(slot, config) for slot in stage.slots}
    if any(text and is_reference(text) for text in asked.values()):
        stand_in = KINDS  # the results belong together: a reference policy is judged on the reference scenes
    for slot in stage.slots:
        matches = [other for other in before if other.kind == slot.kind]
        text = asked[slot.name]
        if text and not slot.every:
            node.fixed[slot.name] = _named(slot, text, stage, store)
            continue
        for other in matches:
            name = other.ref if slot.every else slot.name
            own = config.inputs.get(name.replace("/", "_")) if slot.every else None
            found = store.references.of_kind(slot.kind, other.name if slot.every else None)
            if own:
                node.fixed[name] = _named(slot, own, stage, store)
            elif found and slot.kind in stand_in:
                node.fixed[name] = found.manifest
            else:
                node.upstream[name] = other
        if not matches:
            raise ConfigError(f"{stage.name}: no stage makes its input '{slot.name}'; set inputs.{slot.name}=KIND/NAME")
    return node


def bare_node(
    stage: Stage,
    config: Config,
    overrides: Sequence[str] = (),
    code: Code | None = None,
    name: str | None = None,
) -> Node:
    """A node without its inputs; `name` in place of the stage's own name for its artifact."""
    sections = {name: plain(getattr(config, name), key_only=True) for name in stage.sections}
    view = SectionView(config, stage)
    if outside := stage.outside(view):
        sections["outside"] = outside
    name = name or stage.artifact_name(view)
    return Node(stage, config, tuple(overrides), stage.kind, name, code or _code(stage.module), sections)


def _asked(slot: Slot, config: Config) -> str | None:
    """The artifact that the settings name for a slot; `policy` is meant for whatever takes a student."""
    return config.inputs.get(slot.name) or (config.policy if slot.kind == "student" else None)


def _named(slot: Slot, text: str, stage: Stage, store: Store) -> Manifest:
    allowed = POLICIES if slot.name == "policy" else (slot.kind,)
    manifest = store.manifest(text, (slot.kind,))
    if manifest.kind not in allowed:
        hint = "" if slot.name == "policy" or slot.kind != "student" else "; to evaluate it alone, call wbm evaluate"
        takes = " or ".join(allowed)
        raise ConfigError(f"{stage.name}: {text} is of kind {manifest.kind}, this input takes {takes}{hint}")
    return manifest


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
        node.reasons = _explain(node, store, missing)
        return
    node.key = compute_key(node)
    node.done = store.find(node.kind, node.name, node.key)
    node.reasons = [] if node.done else _explain(node, store, [])


def _explain(node: Node, store: Store, missing: Sequence[str]) -> list[str]:
    newest = store.latest(node.kind, node.name)
    return explain(newest, node.sections, node.code, node.inputs, missing)


def plan(nodes: Sequence[Node], store: Store) -> list[Node]:
    """Look every node up, in order, without running anything."""
    for node in nodes:
        look_up(node, store)
    return list(nodes)
