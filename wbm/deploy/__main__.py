"""`python -m wbm.deploy verify|soak BUNDLE`: on a robot that has numpy and onnxruntime and nothing else of wbm's."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from wbm.deploy.bundle import Bundle
from wbm.deploy.faults import BundleError
from wbm.deploy.soak import soak


def main() -> int:
    """Print one JSON document; 1 where the bundle is refused or a deadline was missed."""
    parser = argparse.ArgumentParser(prog="python -m wbm.deploy", description=__doc__)
    parser.add_argument("action", choices=("verify", "soak"))
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0, help="how long to soak")
    parser.add_argument("--log", type=Path, help="also log as on a robot (MCAP; needs mcap)")
    asked = parser.parse_args()
    try:
        bundle = Bundle.open(asked.bundle)
        answer = bundle.verify()
        if asked.action == "soak":
            answer = soak(bundle, asked.minutes, asked.log)
    except (BundleError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    print(json.dumps(answer, indent=2))
    return 0 if answer.get("ok", True) else 1


if __name__ == "__main__":
    sys.exit(main())
