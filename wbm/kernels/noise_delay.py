"""Late and lost frames: which frame is delivered, and the ring buffer that keeps it until then."""

from typing import Any

import warp as wp

from wbm.kernels.noise import STREAM_DELAY, STREAM_FRAME, noise_state


@wp.kernel(enable_backward=False)
def plan_delivery(
    # in:
    env_ids: wp.array[int],  # [n]
    key: wp.array[int],  # [N] episode
    seed: int,
    delay_min: int,
    delay_max: int,
    lost: float,
    ring: int,
    # inout: frames pushed since the episode began and the one delivered last
    count_io: wp.array[int],  # [N]
    last_io: wp.array[int],  # [N]
    # out:
    write_out: wp.array[int],  # [N] place in the ring
    read_out: wp.array[int],  # [N]
    age_out: wp.array[int],  # [N] steps
):
    """Deliver frame `max(count - delay, 0)`, or the last one again when it is lost; never an older one than before."""
    env = env_ids[wp.tid()]
    count = count_io[env]
    state = noise_state(seed, key[env], 0, STREAM_DELAY, 0)
    delay = wp.min(delay_min + int(wp.randf(state) * float(delay_max - delay_min + 1)), delay_max)
    frame = wp.max(wp.max(count - delay, last_io[env]), 0)
    frame_state = noise_state(seed, key[env], count, STREAM_FRAME, 0)
    if count > 0 and wp.randf(frame_state) < lost:
        frame = last_io[env]
    # The ring forgets: after `ring - 1` steps without a frame the oldest it holds is delivered.
    frame = wp.max(frame, count - ring + 1)
    write_out[env] = count % ring
    read_out[env] = frame % ring
    age_out[env] = count - frame
    last_io[env] = frame
    count_io[env] = count + 1


@wp.kernel(enable_backward=False)
def restart_delivery(
    # in:
    env_ids: wp.array[int],  # [n]
    # out:
    count_out: wp.array[int],  # [N]
    last_out: wp.array[int],
):
    """Begin an episode: the next frame is its first and is delivered at once."""
    env = env_ids[wp.tid()]
    count_out[env] = 0
    last_out[env] = 0


@wp.kernel(enable_backward=False)
def pass_frame(
    # in:
    env_ids: wp.array[int],  # [n]
    write: wp.array[int],  # [N]
    read: wp.array[int],  # [N]
    chunk: int,  # units of a thread
    frame: wp.array2d[Any],  # [N,W] units
    # inout:
    ring_io: wp.array3d[Any],  # [N,ring,W]
    # out:
    frame_out: wp.array2d[Any],  # [N,W]
):
    """Store the new frame's units (words or bytes) and hand out the delivered frame's."""
    i, c = wp.tid()
    env = env_ids[i]
    put = write[env]
    get = read[env]
    for w in range(c * chunk, wp.min((c + 1) * chunk, frame.shape[1])):
        ring_io[env, put, w] = frame[env, w]
        frame_out[env, w] = ring_io[env, get, w]


# Named here, so that they belong to the module from the start: an instance made by its first launch compiles it anew.
PASS_FRAME = {
    unit: wp.overload(
        pass_frame, {"frame": wp.array2d[unit], "ring_io": wp.array3d[unit], "frame_out": wp.array2d[unit]}
    )
    for unit in (wp.uint32, wp.uint8)
}
"""The kernel for rows of whole words and for rows of bytes."""
