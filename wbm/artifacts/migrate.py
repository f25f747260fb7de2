"""Brings manifests of older schema versions up to the present one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.manifest import SCHEMA_VERSION

# version -> function that returns the record as the next version would have written it
STEPS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}


def migrate(record: dict[str, Any], where: str) -> dict[str, Any]:
    """Return `record` in the present schema.

    Args:
        record: a parsed manifest.
        where: named in errors.

    Raises:
        ArtifactError: written by a newer program, or too old for any known step.
    """
    version = record.get("schema_version")
    if not isinstance(version, int):
        raise ArtifactError(f"{where}: manifest.json names no schema version; rebuild the artifact")
    if version > SCHEMA_VERSION:
        raise ArtifactError(
            f"{where}: written in schema {version}, this wbm reads up to {SCHEMA_VERSION}; install a newer wbm"
        )
    while version < SCHEMA_VERSION:
        if version not in STEPS:
            raise ArtifactError(f"{where}: schema {version} is no longer readable; rebuild the artifact")
        record = STEPS[version](record)
        version += 1
        record["schema_version"] = version
    return record
