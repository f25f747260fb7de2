"""Writes eight shards, one at a time, and finds them again after an interruption."""

import os
import time

KIND = "assets"
SECTIONS = ("seed",)
INPUTS = ()
SHARDS, ROWS = 8, 4


def name(cfg):
    return "main"


def run(cfg, inputs, draft, progress):
    from toy.numbers import shard
    from wbm.artifacts import zarr_io

    spec = zarr_io.ArraySpec((SHARDS * ROWS, 3), "int64", chunk=ROWS, shard=ROWS)
    group = zarr_io.create(draft.path / "data.zarr", {"x": spec})
    wrote = 0
    for index in progress.track(range(SHARDS), "shards"):
        mark = draft.scratch / f"{index}.done"
        if not mark.exists():
            time.sleep(float(os.environ.get("TOY_SLEEP", "0")))
            zarr_io.write_shard(group, index, {"x": shard(cfg.seed, index, ROWS)})
            mark.touch()
            wrote += 1
            with open(os.environ.get("TOY_LOG", os.devnull), "a") as log:
                log.write(f"shard {index}\n")
    draft.metrics["rows"] = SHARDS * ROWS
