"""What can go wrong with artifacts, in one line a reader can act on."""

from __future__ import annotations


class ArtifactError(Exception):
    """An artifact is missing, damaged or in the way. The message says what to do."""


class Missing(ArtifactError):
    """No artifact of that name."""


class Conflict(ArtifactError):
    """Another process changed a reference or holds a lease."""
