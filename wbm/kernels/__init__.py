"""Warp kernels: kinematics, distances, the whole-body controller's solvers, rays and noise."""

import os

import warp as wp

# Which module was loaded from which cache is of no use to the users of a pipeline.
wp.config.log_level = wp.LOG_ERROR


def _start_silently() -> None:
    """Start Warp with standard error shut: its C++ part tells a machine without a GPU, each time, that it has none."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()  # what goes wrong is raised
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_start_silently()
