"""The instruction encoder's cache: sentences and their embeddings, and the way to add new ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from wbm.deploy.faults import BundleError, Fault, Refused

Encoder = Callable[[list[str]], np.ndarray]


def normalise(sentence: str) -> str:
    """The form in which sentences are compared: lower case, single spaces, no final stop."""
    return " ".join(sentence.lower().split()).rstrip(".!")


class InstructionCache:
    """Sentence embeddings [K, text_dim] by sentence.

    Args:
        embeddings: one row a sentence.
        encoder: optional function from sentences to embeddings [n, text_dim] for sentences that are not cached.
    """

    def __init__(self, embeddings: dict[str, np.ndarray], text_dim: int, encoder: Encoder | None = None) -> None:
        self.text_dim = text_dim
        self.encoder = encoder
        self._rows: dict[str, np.ndarray] = {}
        for sentence, row in embeddings.items():
            self._add(sentence, row)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Cached sentences in alphabetical order."""
        return tuple(sorted(self._rows))

    def _add(self, sentence: str, row: np.ndarray) -> None:
        row = np.asarray(row, dtype=np.float32)
        if row.shape != (self.text_dim,) or not np.isfinite(row).all():
            raise ValueError(f"embedding of {sentence!r} has shape {row.shape}, expected finite ({self.text_dim},)")
        self._rows[normalise(sentence)] = row

    def embed(self, sentence: str) -> np.ndarray:
        """Embedding [text_dim] of a sentence; the empty sentence is all zeros (no instruction).

        Raises:
            Refused: `UNKNOWN_INSTRUCTION` when the sentence is neither cached nor can be encoded.
        """
        key = normalise(sentence)
        if not key:
            return np.zeros(self.text_dim, dtype=np.float32)
        if key not in self._rows:
            if self.encoder is None:
                raise Refused(
                    Fault.UNKNOWN_INSTRUCTION,
                    f"{sentence!r} is not among the {len(self)} cached sentences; "
                    "set .encoder (docs/deploy.md) or use one of them",
                )
            self._add(sentence, np.asarray(self.encoder([sentence]))[0])
        return self._rows[key]

    def extend(self, sentences: Iterable[str]) -> None:
        """Encode and cache sentences before the robot starts to move."""
        for sentence in sentences:
            self.embed(sentence)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Arrays for the bundle: UTF-8 text joined by newlines, and the rows in the same order."""
        rows = [self._rows[s] for s in self.sentences]
        return {
            "sentences": np.frombuffer("\n".join(self.sentences).encode(), dtype=np.uint8),
            "embeddings": np.stack(rows) if rows else np.zeros((0, self.text_dim), dtype=np.float32),
        }

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray], text_dim: int) -> InstructionCache:
        """Rebuild a cache.

        Raises:
            BundleError: `CONTRACT` when rows and sentences do not fit.
        """
        try:
            text = arrays["sentences"].tobytes().decode()
            sentences = text.split("\n") if text else []
            return InstructionCache(dict(zip(sentences, arrays["embeddings"], strict=True)), text_dim)
        except (KeyError, ValueError) as error:
            raise BundleError(Fault.CONTRACT, f"instructions.npz: {error}") from error
