"""Batched physics behind one interface: MuJoCo C on CPUs, MuJoCo Warp on GPUs."""
