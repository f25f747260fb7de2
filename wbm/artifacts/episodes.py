"""Whole episodes on disk: one Zarr v3 array of packed rows a shard, with an index written last.

A shard `shard-00003` is a directory `shard-00003.zarr` (group with the array `steps` [rows, row_bytes], sharded, Zstd)
and a file `shard-00003.json`, the index. The index is renamed into place when everything else is on disk, so a shard
either exists whole or does not exist; one writer owns one shard. Zarr reads a missing shard file as zeros: the reader
trusts only what the index lists, with sizes. See docs/dataset.md.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import TransposeCodec, ZstdCodec

from wbm.artifacts.episode_layout import (
    CHUNK_STEPS,
    FORMAT_VERSION,
    SHARD_STEPS,
    STARTS,
    TEXT_FIELD,
    EpisodeInfo,
    StepLayout,
    shard_index,
)


class EpisodeWriter:
    """Writes one shard. Nothing is readable until `close` has returned.

    Args:
        path: directory of shards, made if needed.
        schema: the policy schema (`wbm.robot.schema.PolicySchema`) of the observations.
        shard_id: number of the shard; one writer a shard.

    Raises:
        FileExistsError: the shard is complete already. What an interrupted writer left is replaced.
    """

    def __init__(self, path: str | os.PathLike[str], schema: Any, shard_id: int) -> None:
        self._dir = Path(path)
        self._index_path = shard_index(path, shard_id)
        self._zarr_path = self._index_path.with_suffix(".zarr")
        if self._index_path.exists():
            raise FileExistsError(f"{self._index_path} is complete already; write another shard or remove it")
        self._schema = schema
        self._layout = StepLayout.of_schema(schema)
        self._text_dim = int(schema.text_dim)
        self._rows: list[np.ndarray] = []
        self._pending = 0
        self._written = 0
        self._episodes: list[EpisodeInfo] = []
        self._sentences: dict[str, int] = {}
        self._embeddings: list[np.ndarray] = []
        self._closed = False
        try:
            self._dir.mkdir(parents=True, exist_ok=True)
            if self._zarr_path.exists():
                shutil.rmtree(self._zarr_path)
            group = zarr.create_group(store=str(self._zarr_path), zarr_format=3)
            self._array = group.create_array(
                "steps",
                shape=(0, self._layout.row_bytes),
                chunks=(CHUNK_STEPS, self._layout.row_bytes),
                shards=(SHARD_STEPS, self._layout.row_bytes),
                dtype="uint8",
                filters=[TransposeCodec(order=(1, 0))],  # bytes of a value through time lie side by side: smaller
                compressors=[ZstdCodec(level=3, checksum=True)],
                fill_value=0,
                config={"write_empty_chunks": True},
                attributes={"fields": self._layout.to_list()},
            )
        except OSError as error:
            raise self._explain(error) from error

    @property
    def num_steps(self) -> int:
        """Steps added so far."""
        return self._written + self._pending

    @property
    def num_episodes(self) -> int:
        """Episodes added so far."""
        return len(self._episodes)

    def add(self, episode: dict[str, Any]) -> None:
        """Append a whole episode.

        Args:
            episode: the schema's observation fields but "text", and `LABELS`, each [T, ...]; "instructions", sentences
                that name the target; "text" [len(instructions), text_dim], their embeddings; and the scalars scene,
                object, teacher, noise, start, success, seed of `EpisodeInfo`.

        Raises:
            ValueError: a field is missing, misshapen or not finite; the writer is closed.
            OSError: the disk is full or cannot be written.
        """
        if self._closed:
            raise ValueError(f"{self._zarr_path} is closed")
        meta = ("scene", "object", "teacher", "noise", "start", "success", "seed", "instructions", TEXT_FIELD)
        missing = [name for name in meta if name not in episode]
        if missing:
            raise ValueError(f"episode field {missing[0]!r} is missing")
        if episode["start"] not in STARTS:
            raise ValueError(f"episode start is {episode['start']!r}, expected one of {', '.join(STARTS)}")
        rows = self._layout.pack({f.name: episode[f.name] for f in self._layout.fields if f.name in episode})
        if not len(rows):
            raise ValueError("an episode must have at least one step")
        instructions = self._sentence_rows(list(episode["instructions"]), np.asarray(episode[TEXT_FIELD], np.float32))
        info = EpisodeInfo(
            first=self.num_steps,
            length=len(rows),
            instructions=instructions,
            scene=str(episode["scene"]),
            object=str(episode["object"]),
            teacher=str(episode["teacher"]),
            noise=float(episode["noise"]),
            start=str(episode["start"]),
            success=bool(episode["success"]),
            seed=int(episode["seed"]),
        )
        self._rows.append(rows)
        self._pending += len(rows)
        self._episodes.append(info)
        while self._pending >= SHARD_STEPS:
            self._flush(SHARD_STEPS)

    def close(self) -> Path:
        """Write what is pending, bring it to disk, then publish the index; its path.

        Raises:
            OSError: the disk is full or cannot be written; the shard stays unreadable and can be written again.
        """
        if self._closed:
            return self._index_path
        if self._pending:
            self._flush(self._pending)
        try:
            embeddings = np.stack(self._embeddings) if self._embeddings else np.zeros((0, self._text_dim), np.float32)
            zarr.open_group(str(self._zarr_path)).create_array(TEXT_FIELD, data=embeddings, overwrite=True)
        except OSError as error:
            raise self._explain(error) from error
        files = sorted(p for p in self._zarr_path.rglob("*") if p.is_file())
        index = {
            "format": FORMAT_VERSION,
            "schema": self._schema.to_dict(),
            "fields": self._layout.to_list(),
            "chunk_steps": CHUNK_STEPS,
            "shard_steps": SHARD_STEPS,
            "num_steps": self._written,
            "files": {str(p.relative_to(self._dir)): p.stat().st_size for p in files},
            "episodes": [asdict(e) for e in self._episodes],
            "sentences": list(self._sentences),
        }
        partial = self._index_path.with_suffix(".json.partial")
        try:
            for item in [*files, *(p for p in self._zarr_path.rglob("*") if p.is_dir()), self._zarr_path]:
                _fsync(item)
            with open(partial, "w", encoding="utf-8") as stream:
                json.dump(index, stream, separators=(",", ":"))
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(partial, self._index_path)
            _fsync(self._dir)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise self._explain(error) from error
        self._closed = True
        return self._index_path

    def _sentence_rows(self, sentences: list[str], embeddings: np.ndarray) -> tuple[int, ...]:
        if not sentences:
            raise ValueError("episode field 'instructions' is empty; give at least one sentence")
        if embeddings.shape != (len(sentences), self._text_dim):
            expected = (len(sentences), self._text_dim)
            raise ValueError(f"episode field 'text' has shape {embeddings.shape}, expected {expected}")
        for sentence, embedding in zip(sentences, embeddings, strict=True):
            if sentence not in self._sentences:
                self._sentences[sentence] = len(self._sentences)
                self._embeddings.append(embedding)
        return tuple(self._sentences[s] for s in sentences)

    def _flush(self, count: int) -> None:
        rows = np.concatenate(self._rows)
        try:
            self._array.resize((self._written + count, self._layout.row_bytes))
            self._array[self._written : self._written + count] = rows[:count]
        except OSError as error:
            raise self._explain(error) from error
        self._rows = [rows[count:].copy()]
        self._written += count
        self._pending -= count

    def _explain(self, error: OSError) -> OSError:
        reason = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else str(error.strerror or error)
        return OSError(
            error.errno, f"cannot write {self._zarr_path}: {reason}; free space and run again, it starts anew"
        )


def _fsync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
