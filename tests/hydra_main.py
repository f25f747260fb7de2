"""A real `@hydra.main` program on the same `conf/`: reads override lines from standard input, answers in JSON lines.

Each line goes through the whole of Hydra's own start-up: argument parser, composition, job. The program's body builds
the typed configuration as any program with a schema would.
"""

import contextlib
import io
import json
import os
import sys
import tempfile

import hydra
from hydra.core.global_hydra import GlobalHydra

from stages.compose import build, conf_dir, register
from wbm.artifacts.digest import plain

result = {}


@hydra.main(config_path=str(conf_dir()), config_name="config", version_base="1.3")
def program(cfg):
    result["config"] = plain(build(cfg))


def main():
    register()
    os.chdir(tempfile.mkdtemp())
    for line in sys.stdin:
        overrides = json.loads(line)
        sys.argv = ["program", "hydra.output_subdir=null", "hydra.run.dir=.", "hydra/job_logging=none",
                    "hydra/hydra_logging=none", *overrides]  # fmt: skip
        result.clear()
        GlobalHydra.instance().clear()
        errors = io.StringIO()
        with contextlib.redirect_stderr(errors), contextlib.suppress(SystemExit):
            program()
        print(json.dumps(result.get("config")), flush=True)


main()
