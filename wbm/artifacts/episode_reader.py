"""Random access to whole episodes on disk: the other side of `wbm.artifacts.episodes`."""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from dataclasses import asdict
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from numcodecs.zstd import Zstd

from wbm.artifacts.episode_layout import FORMAT_VERSION, TEXT_FIELD, EpisodeInfo, StepLayout

_MISSING = np.uint64(2**64 - 1)
_OPEN_FILES = 64


class EpisodeReader:
    """Random access to one complete shard.

    Chunks are taken from the shard file by its own index (Zarr's sharding layout), which costs 20 us where the Zarr
    library takes 1.5 ms; checksums are verified on the way.

    Args:
        path: the index, `shard-?????.json`.
        schema: if given, the policy schema that the shard must have been written with.

    Raises:
        FileNotFoundError: the index, or a file that it lists, does not exist.
        ValueError: another format, another schema, or a file that has not the size that the index lists.
    """

    def __init__(self, path: str | os.PathLike[str], schema: Any = None) -> None:
        self.path = Path(path)
        try:
            index = json.loads(self.path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{self.path} is not an episode index: {error}") from error
        if index.get("format") != FORMAT_VERSION:
            raise ValueError(
                f"{self.path} has episode format {index.get('format')}, this version reads {FORMAT_VERSION}"
            )
        self.schema: dict[str, Any] = index["schema"]
        if schema is not None and self.schema != json.loads(json.dumps(schema.to_dict())):
            what = "version" if self.schema.get("version") != schema.version else "fields"
            raise ValueError(f"{self.path} was written with another policy schema (its {what} differ); make it again")
        self.layout = StepLayout.from_list(index["fields"])
        self.episodes = [EpisodeInfo(**{**e, "instructions": tuple(e["instructions"])}) for e in index["episodes"]]
        self.sentences: list[str] = index["sentences"]
        self.num_steps = int(index["num_steps"])
        self._chunk, self._shard = int(index["chunk_steps"]), int(index["shard_steps"])
        root = self.path.parent.resolve()
        for name, size in index["files"].items():
            file = root / name
            if not file.resolve().is_relative_to(root):
                raise ValueError(f"{self.path} lists {name!r}, which lies outside its folder")
            if not file.is_file():
                raise FileNotFoundError(f"{file} is missing; the shard is damaged, make it again")
            if file.stat().st_size != size:
                raise ValueError(f"{file} has {file.stat().st_size} bytes, its index says {size}; make the shard again")
        self._data = root / f"{self.path.stem}.zarr" / "steps" / "c"
        for k in range(-(-self.num_steps // self._shard)):
            if f"{self.path.stem}.zarr/steps/c/{k}/0" not in index["files"]:
                raise ValueError(f"{self.path} does not list the rows from {k * self._shard} on; make the shard again")
        self.embeddings = np.asarray(zarr.open_group(str(root / f"{self.path.stem}.zarr"), mode="r")[TEXT_FIELD][:])  # pyright: ignore[reportArgumentType]
        self._files: OrderedDict[int, tuple[int, np.ndarray]] = OrderedDict()
        self._zstd = Zstd()

    def read(self, start: int, stop: int, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
        """Steps [start, stop) of the shard: arrays [stop - start, *shape] of all step fields or of those named.

        Raises:
            IndexError: outside the shard.
            ValueError: a chunk is damaged.
        """
        return self.layout.unpack(self.rows(start, stop), names)

    def read_episode(self, number: int) -> dict[str, Any]:
        """A whole episode: step fields, "text", "instructions" and the scalars, as `EpisodeWriter.add` takes it."""
        info = self.episodes[number]
        out: dict[str, Any] = self.read(info.first, info.first + info.length)
        ids = list(info.instructions)
        out.update({k: v for k, v in asdict(info).items() if k not in ("first", "length")})
        out["instructions"] = [self.sentences[i] for i in ids]
        out[TEXT_FIELD] = self.embeddings[ids]
        return out

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Packed rows [stop - start, row_bytes] uint8; one chunk is read when the range lies in one."""
        if not 0 <= start < stop <= self.num_steps:
            raise IndexError(f"steps {start} to {stop} are outside {self.path}, which has {self.num_steps}")
        first, last = start // self._chunk, (stop - 1) // self._chunk
        parts = [self._read_chunk(k) for k in range(first, last + 1)]
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return rows[start - first * self._chunk : stop - first * self._chunk]

    def close(self) -> None:
        """Close the shard's files; they are opened again when needed."""
        while self._files:
            os.close(self._files.popitem()[1][0])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": OrderedDict()}

    def __del__(self) -> None:
        if hasattr(self, "_files"):
            self.close()

    def _open(self, number: int) -> tuple[int, np.ndarray]:
        if number in self._files:
            self._files.move_to_end(number)
            return self._files[number]
        if len(self._files) >= _OPEN_FILES:
            os.close(self._files.popitem(last=False)[1][0])
        fd = os.open(self._data / str(number) / "0", os.O_RDONLY)
        count = self._shard // self._chunk
        tail = os.pread(fd, 16 * count + 4, os.fstat(fd).st_size - 16 * count - 4)
        if len(tail) != 16 * count + 4 or google_crc32c.value(tail[:-4]) != int.from_bytes(tail[-4:], "little"):
            os.close(fd)
            raise ValueError(f"{self._data / str(number) / '0'} has a damaged shard index; make the shard again")
        self._files[number] = fd, np.frombuffer(tail[:-4], "<u8").reshape(count, 2)
        return self._files[number]

    def _read_chunk(self, chunk: int) -> np.ndarray:
        number, place = divmod(chunk, self._shard // self._chunk)
        fd, table = self._open(number)
        offset, size = table[place]
        try:
            if offset == _MISSING:
                raise ValueError("not written")
            data = self._zstd.decode(os.pread(fd, int(size), int(offset)))
            return np.frombuffer(data, np.uint8).reshape(self.layout.row_bytes, self._chunk).T
        except (ValueError, RuntimeError) as error:
            file, first = self._data / str(number) / "0", chunk * self._chunk
            raise ValueError(f"{file} is damaged at steps {first} and on ({error}); make the shard again") from error


def shard_paths(folder: str | os.PathLike[str]) -> list[Path]:
    """Indices of all complete shards in a folder, sorted.

    Raises:
        FileNotFoundError: there is none.
    """
    found = sorted(Path(folder).glob("shard-*.json"))
    if not found:
        raise FileNotFoundError(f"{folder} holds no complete shard (shard-*.json); run generate-rollouts")
    return found
