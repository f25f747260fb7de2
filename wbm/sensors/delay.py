"""Latency: frames reach the policy late, and some never do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from wbm.kernels.noise_delay import PASS_FRAME, plan_delivery, restart_delivery
from wbm.sensors.config import DelayConfig


class FrameDelay:
    """A ring buffer of frames an environment; a frame is a set of arrays with a row an environment.

    Attributes:
        out: the delivered arrays, same names, shapes and types.
        age: [N] int32, steps since the delivered frame was measured.
    """

    def __init__(self, config: DelayConfig, frame: Mapping[str, wp.array], key: wp.array, seed: int = 0) -> None:
        """Allocate the ring.

        Args:
            config: when frames are delivered.
            frame: live arrays [N,...] that hold the newest frame, all contiguous.
            key: [N] int32 live episode key, as the sensors use it.
            seed: of the draws.
        """
        self.config, self.key, self.seed, self._frame = config, key, int(seed), dict(frame)
        device, n = key.device, key.shape[0]
        self._ring_size = config.delay_max + (config.hold_max if config.lost > 0 else 0) + 1
        self._count, self._last = (wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2))
        self._write, self._read = (wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2))
        self.age = wp.zeros(n, dtype=wp.int32, device=device)
        self.out = {name: wp.zeros_like(array) for name, array in self._frame.items()}
        self._views = []
        for name, array in self._frame.items():
            width = int(array.strides[0]) if n else 0  # pyright: ignore[reportArgumentType]
            dtype, size = (wp.uint32, 4) if width % 4 == 0 else (wp.uint8, 1)
            ring = wp.zeros((n, self._ring_size, width // size), dtype=dtype, device=device)
            out = self.out[name]
            self._views.append((_words(array, n, width // size, dtype), ring, _words(out, n, width // size, dtype)))

    def reset(self, env_ids: wp.array) -> None:
        """Start an episode in the given environments (device index array): frames from before it are forgotten."""
        if env_ids.shape[0] > 0:
            wp.launch(
                restart_delivery,
                dim=env_ids.shape[0],
                inputs=[env_ids],
                outputs=[self._count, self._last],
                device=self.key.device,
            )

    def push(self, env_ids: wp.array) -> None:
        """Take the newest frame of the given environments and update `out` and `age`."""
        if env_ids.shape[0] == 0:
            return
        c, device = self.config, self.key.device
        wp.launch(
            plan_delivery,
            dim=env_ids.shape[0],
            inputs=[
                env_ids, self.key, self.seed, c.delay_min, c.delay_max, c.lost, self._ring_size, self._count,
                self._last,
            ],
            outputs=[self._write, self._read, self.age],
            device=device,
        )  # fmt: skip
        for source, ring, out in self._views:
            # A CPU thread takes a whole row, which spares the cost of starting a thread a word.
            chunk = max(source.shape[1], 1) if device.is_cpu else 1
            wp.launch(
                PASS_FRAME[ring.dtype],
                dim=(env_ids.shape[0], -(-source.shape[1] // chunk)),
                inputs=[env_ids, self._write, self._read, chunk, source, ring],
                outputs=[out],
                device=device,
            )


def _words(array: wp.array, rows: int, width: int, dtype: Any) -> wp.array:
    """The array's memory as [rows,width] words; the caller keeps the array alive."""
    if rows == 0 or width == 0:
        return wp.zeros((rows, width), dtype=dtype, device=array.device)
    if not array.is_contiguous:
        raise ValueError("FrameDelay: frame arrays must be contiguous")
    return wp.array(ptr=array.ptr, dtype=dtype, shape=(rows, width), device=array.device)
