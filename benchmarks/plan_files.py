"""Time of `wbm plan` where an artifact lists 100,000 files: python benchmarks/plan_files.py [--files N]

A toy pipeline is run into an empty store, the manifest of its assets is given N files, and `plan --check` is started
as a user starts it. The same on an empty store shows what is start-up.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

from wbm.artifacts.manifest import FileEntry, parse_manifest

HERE = Path(__file__).resolve().parents[1]
ENV = {**os.environ, "PYTHONPATH": f"{HERE}:{HERE / 'tests'}"}
ROUNDS = 3


def toy(*arguments: str) -> tuple[float, float]:
    """Wall and processor seconds of a command of the toy pipeline.

    Raises:
        RuntimeError: it failed.
    """
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run([sys.executable, "-m", "toy", *arguments], env=ENV, cwd=HERE, capture_output=True, text=True)
    wall, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        raise RuntimeError(done.stderr)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def grow(manifest: Path, count: int) -> None:
    """List files in a manifest until there are `count`."""
    known = parse_manifest(manifest.read_bytes(), str(manifest))
    files = [*known.files]
    for i in range(count - len(files)):
        digest = blake2b(str(i).encode(), digest_size=32).hexdigest()
        files.append(FileEntry(f"data.zarr/x/c/{i}/0", 1000, digest, ""))
    manifest.write_bytes(replace(known, files=tuple(files)).to_bytes())


def main() -> None:
    """Print the fastest of a few runs of each kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=100_000)
    count = parser.parse_args().files
    with tempfile.TemporaryDirectory() as folder:
        root = f"artifacts.root={folder}/store"
        toy("run", root)
        manifest = next(Path(folder, "store").glob("assets/main/*/manifest.json"))
        grow(manifest, count)
        for title, where in ((f"{count} files", root), ("an empty store", f"artifacts.root={folder}/empty")):
            wall, cpu = min(toy("plan", "--check", where) for _ in range(ROUNDS))
            print(f"plan, {title}: {wall:.2f} s, {cpu:.2f} s of processor time")


if __name__ == "__main__":
    main()
