"""A local store and a real S3 server on loopback behind one fixture."""

from __future__ import annotations

import os
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from wbm.artifacts.digest import digest_value
from wbm.artifacts.manifest import InputRef, Manifest
from wbm.artifacts.store import Artifact, Store


@contextmanager
def s3_server(cache: Path) -> Iterator[str]:
    """Start moto's server and yield the URL of an empty bucket."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    environment = {
        "AWS_ENDPOINT": f"http://{host}:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
        "WBM_CACHE": str(cache),
    }
    with mock.patch.dict(os.environ, environment):
        urllib.request.urlopen(urllib.request.Request(f"http://{host}:{port}/lab", method="PUT")).read()
        yield "s3://lab/wbm"
    server.stop()


def manifest(
    name: str = "main", kind: str = "assets", seed: int = 0, inputs: dict[str, Artifact] | None = None
) -> Manifest:
    """A manifest as a stage run would begin with."""
    refs = {slot: InputRef(a.ref, a.manifest.content_digest) for slot, a in (inputs or {}).items()}
    key = digest_value([kind, name, seed, sorted(r.content_digest for r in refs.values())])
    return Manifest(kind=kind, name=name, key=key, stage="test", config={"seed": seed}, inputs=refs)


def publish(store: Store, files: dict[str, bytes], **kwargs) -> Artifact:
    """Publish files as one artifact."""
    force = kwargs.pop("force", False)
    draft = store.begin(manifest(**kwargs), force=force)
    for path, data in files.items():
        (draft.path / path).parent.mkdir(parents=True, exist_ok=True)
        (draft.path / path).write_bytes(data)
    return draft.publish()
