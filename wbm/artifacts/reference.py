"""Reference results: published artifacts that are committed with the program, small and free of traces of a machine."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

from wbm.artifacts.backend import swap
from wbm.artifacts.digest import KEY_LENGTH
from wbm.artifacts.errors import ArtifactError, Missing
from wbm.artifacts.files import fsync_path, fsync_tree, make_dirs, remove_tree
from wbm.artifacts.manifest import KEY, LOGS, MANIFEST, NAME, Artifact, Manifest, check_files, read_manifest, seal

WORD = "reference"
LIMIT_MB = 20.0  # all reference results together: what a clone may cost


def is_reference(text: str) -> bool:
    """Whether `text` names a reference result: `reference` or `reference/<name>`."""
    return text == WORD or text.startswith(f"{WORD}/")


class References:
    """The reference results in one folder, a folder `<name>` each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def names(self) -> list[str]:
        """`reference/<name>` of all, sorted."""
        found = sorted(self.folder.iterdir()) if self.folder.is_dir() else []
        return [f"{WORD}/{p.name}" for p in found if NAME.fullmatch(p.name) and (p / MANIFEST).is_file()]

    def get(self, text: str, kinds: Sequence[str] = ()) -> Artifact:
        """Find `reference/<name>`; bare `reference` is the main result of the first of `kinds` that there is.

        Raises:
            Missing: no such result; the message lists what there is.
            ArtifactError: its manifest is damaged.
        """
        if text == WORD:
            for kind in kinds:
                if found := self.of_kind(kind):
                    return found
            wanted = f"no {' or '.join(kinds)} among them" if kinds else "name one of them"
            raise Missing(f"{text}: {wanted}; {self._hint()}")
        if text not in self.names():
            raise Missing(f"{text}: no such reference result; {self._hint()}")
        folder = self.folder / text.removeprefix(f"{WORD}/")
        return Artifact(folder, read_manifest(folder))

    def _hint(self) -> str:
        names = ", ".join(self.names())
        return f"there are {names}" if names else f"there are none in {self.folder}"

    def of_kind(self, kind: str, name: str | None = None) -> Artifact | None:
        """The result of a kind and, when given, a name of the artifact.

        Of several, the one that is called like its kind (`reference/student`), else none.
        """
        found = {text: self.get(text) for text in self.names()}
        found = {t: a for t, a in found.items() if a.manifest.kind == kind and name in (None, a.manifest.name)}
        if len(found) == 1:
            return next(iter(found.values()))
        return found.get(f"{WORD}/{kind}")

    def with_ref(self, ref: str) -> Artifact | None:
        """The result that was published as `kind/name/key`, at least 12 digits of the key."""
        stem, _, key = ref.rpartition("/")
        if not KEY.fullmatch(key):
            return None
        for text in self.names():
            artifact = self.get(text)
            if artifact.ref == f"{stem}/{key[:KEY_LENGTH]}":
                return artifact
        return None

    def size(self) -> int:
        """Bytes of all files of all results, manifests included."""
        return sum(p.stat().st_size for p in self.folder.rglob("*") if p.is_file())


@dataclass(frozen=True)
class Published:
    """What `publish_reference` wrote: its name, and the inputs that are no reference results themselves."""

    text: str
    artifact: Artifact
    missing_inputs: tuple[str, ...]


def publish_reference(
    artifact: Artifact,
    references: References,
    name: str | None = None,
    without: Sequence[str] = (),
    limit_mb: float = LIMIT_MB,
) -> Published:
    """Copy an artifact to the reference results, whole or not at all; one of this name is replaced.

    Logs are left out, and of the manifest what tells of the machine: host name and paths. Its key, inputs, code, git
    state, versions, seeds and metrics stay. Without patterns the content digest stays too.

    Args:
        artifact: of any store.
        references: where to.
        name: default: the artifact's kind for `kind/main`, else `kind_name`.
        without: patterns of files to leave out, such as `mcap/*`; the manifest then says so under `trimmed`.
        limit_mb: largest size of all reference results together.

    Raises:
        ArtifactError: damaged, made by code that no commit holds, a bad name, a path of this machine in a file, or too
            large.
    """
    manifest = artifact.manifest
    name = name or (manifest.kind if manifest.name == "main" else f"{manifest.kind}_{manifest.name}")
    if not NAME.fullmatch(name):
        raise ArtifactError(f"--as {name}: names hold letters, digits, dot, dash and underscore")
    if problems := check_files(manifest, artifact.path):
        raise ArtifactError(f"{problems[0]}; a damaged artifact is no reference result")
    if not manifest.git.get("commit"):
        raise ArtifactError(
            f"{artifact.ref}: its manifest names no commit, so nobody can make it again; run its stage in a checkout"
        )
    make_dirs(references.folder)
    incoming, target = references.folder / f".{name}.incoming", references.folder / name
    shutil.rmtree(incoming, ignore_errors=True)
    try:
        for entry in manifest.files:
            if entry.path.startswith(LOGS) or any(fnmatch(entry.path, pattern) for pattern in without):
                continue
            (incoming / entry.path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(artifact.path / entry.path, incoming / entry.path)
        _check_paths(incoming, artifact.path.parents[2])
        fresh = seal(_anonymous(manifest), incoming)
        if without:
            trimmed = {"content_digest": manifest.content_digest, "left_out": sorted(without)}
            fresh = replace(fresh, trimmed=trimmed)
        elif fresh.content_digest != manifest.content_digest:
            raise ArtifactError(f"{artifact.ref}: changed while it was copied; run verify")
        (incoming / MANIFEST).write_bytes(fresh.to_bytes())
        _check_size(references, incoming, target, name, limit_mb)
        fsync_tree(incoming)
        swap(incoming, target) if target.exists() else os.rename(incoming, target)
        fsync_path(references.folder)
    finally:
        remove_tree(incoming)
    published = Artifact(target, fresh)
    there = {references.get(text).ref for text in references.names()}
    return Published(f"{WORD}/{name}", published, tuple(i.ref for i in fresh.inputs.values() if i.ref not in there))


def _anonymous(manifest: Manifest) -> Manifest:
    """The manifest without what concerns one machine only."""
    words = [w for w in manifest.command.split() if not w.startswith(("artifacts.", "'artifacts."))]
    environment = {k: v for k, v in manifest.environment.items() if k != "host"}
    return replace(manifest, command=" ".join(words), environment=environment, files=())


def _check_paths(folder: Path, root: Path) -> None:
    """What others clone names no place on this machine."""
    for path in (p for p in folder.rglob("*") if p.is_file()):
        if os.fsencode(root) in path.read_bytes():
            name = path.relative_to(folder).as_posix()
            raise ArtifactError(f"{name} holds the path {root}; leave it out with --without {name}")


def _check_size(references: References, incoming: Path, target: Path, name: str, limit_mb: float) -> None:
    replaced = sum(p.stat().st_size for p in target.rglob("*") if p.is_file())
    total = (references.size() - replaced) / 1e6  # `incoming` lies in the same folder
    if total > limit_mb:
        own = sum(p.stat().st_size for p in incoming.rglob("*") if p.is_file()) / 1e6
        raise ArtifactError(
            f"reference/{name}: {own:.1f} MB make {total:.1f} MB of reference results, {limit_mb:g} MB are allowed; "
            "leave files out with --without PATTERN, or raise --limit-mb"
        )
