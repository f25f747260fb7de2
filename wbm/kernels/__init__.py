"""Warp kernels: kinematics, distances, the whole-body controller's solvers, rays and noise."""

import warp as wp

# Which module was loaded from which cache is of no use to the users of a pipeline.
wp.config.quiet = True
