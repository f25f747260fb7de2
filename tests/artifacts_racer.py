"""One process of a race: threads that increment a counter, move `latest`, and publish one key, all at the same time.

`python artifacts_racer.py STORE THREADS FIRST` prints one JSON document: each operation with the times around it.
"""

import json
import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from artifacts_support import manifest

from wbm.artifacts.errors import Conflict
from wbm.artifacts.store import Store

COUNTER = "refs/race/counter/latest"


def increment(backend, number):
    """Add one by compare-and-swap, reading before and after; the history of this writer."""
    history, rng, pause = [], random.Random(number), 0.002
    while True:
        began = time.monotonic_ns()
        found = backend.read(COUNTER)
        value = json.loads(found[0])["key"] if found else 0
        history.append(["read", value, began, time.monotonic_ns()])
        began = time.monotonic_ns()
        try:
            record = json.dumps({"generation": value + 1, "key": value + 1}).encode()
            backend.write(COUNTER, record, found[1] if found else "")
        except Conflict:
            time.sleep(rng.uniform(0, pause))
            pause = min(2 * pause, 0.2)
            continue
        history.append(["write", value + 1, began, time.monotonic_ns()])
        return history


def publish(store, number):
    """Try to be the one that publishes a key; this writer's number when it was."""
    try:
        draft = store.begin(manifest(name="one"))
    except Conflict:
        return None
    (draft.path / "who").write_text(str(number))
    draft.publish()
    return number


def main():
    store, threads, first = Store.open(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    numbers = range(first, first + threads)
    with ThreadPoolExecutor(threads) as pool:
        histories = list(pool.map(lambda n: increment(store.backend, n), numbers))
        list(pool.map(lambda n: store.set_latest("race", "newest", f"{n:064x}"), numbers))
        winners = [n for n in pool.map(lambda n: publish(store, n), numbers) if n is not None]
    print(json.dumps({"history": [o for h in histories for o in h], "winners": winners}))


main()
