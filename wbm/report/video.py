"""Films and stills of episodes from any renderer, without a display and without OpenGL."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from wbm.sensors.poses import look_at

RenderRgb = Callable[..., np.ndarray]
"""`render_rgb(scene, env, pos, quat, width, height, fov_deg)`: uint8 [height, width, 3] from a camera at `pos` (W, m)
with optical orientation `quat` (w x y z; x right, y down, z forward)."""

_H264 = [
    "-crf", "26", "-preset", "veryfast", "-movflags", "+faststart",
    # one thread and no names of programs: same frames, same bytes
    "-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1",
]  # fmt: skip

KEY_PHASES = ("approach", "tracking", "preshape", "contact", "lift")


def write_mp4(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> int:
    """Encode uint8 frames [H,W,3] as H.264 that every browser plays; returns the number of frames.

    Raises:
        ValueError: no frame, or odd or changing sizes.
    """
    import imageio_ffmpeg

    writer, count, shape = None, 0, None
    try:
        for frame in frames:
            if writer is None:
                shape = frame.shape
                if shape[0] % 2 or shape[1] % 2:
                    raise ValueError(f"video {path}: frames are {shape[1]} x {shape[0]}, H.264 needs even sizes")
                # its annotations are narrower than what it takes
                writer = imageio_ffmpeg.write_frames(  # pyright: ignore
                    str(path), (shape[1], shape[0]), fps=fps, codec="libx264", pix_fmt_out="yuv420p",  # pyright: ignore[reportArgumentType]
                    macro_block_size=2, ffmpeg_log_level="error", quality=None, ffmpeg_timeout=60,  # pyright: ignore[reportArgumentType]
                    output_params=_H264,
                )  # fmt: skip
                writer.send(None)
            if frame.shape != shape:
                raise ValueError(f"video {path}: frame {count} has shape {frame.shape}, the first had {shape}")
            writer.send(np.ascontiguousarray(frame, dtype=np.uint8))
            count += 1
    finally:
        if writer is not None:
            writer.close()
    if not count:
        raise ValueError(f"video {path}: no frames")
    return count


def follow_camera(
    base_pos: np.ndarray, target_pos: np.ndarray, distance: float = 2.1, height: float = 1.5
) -> tuple[np.ndarray, np.ndarray]:
    """Eye [3] and optical quaternion [4] that show robot and target side by side, from the robot's right.

    Args:
        base_pos: base position in W, m.
        target_pos: position of the object to grasp in W, m.
        distance: horizontal distance from the middle of both, m, grown when they are far apart.
        height: height of the eye, m.
    """
    base = np.array([base_pos[0], base_pos[1], 0.5])
    target = np.asarray(target_pos, float)
    along = target[:2] - base[:2]
    gap = float(np.linalg.norm(along))
    forward = along / gap if gap > 1e-6 else np.array([1.0, 0.0])
    side = np.array([forward[1], -forward[0]])
    middle = 0.45 * base + 0.55 * target
    eye = np.append(middle[:2] + (distance + 0.35 * gap) * (0.86 * side - 0.5 * forward), height)
    return eye, look_at(eye, middle)


def inset(frame: np.ndarray, small: np.ndarray, margin: int = 8) -> np.ndarray:
    """`frame` with `small` and a thin border in its lower right corner, where the floor is."""
    h, w = small.shape[:2]
    result = frame.copy()
    top, left = frame.shape[0] - h - margin, frame.shape[1] - w - margin
    result[top - 2 : top + h + 2, left - 2 : left + w + 2] = 245
    result[top : top + h, left : left + w] = small
    return result


def film_frame(
    render_rgb: RenderRgb,
    scene: Any,
    env: int,
    base_pos: np.ndarray,
    target_pos: np.ndarray,
    camera: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
    camera_fov_deg: float = 58.0,
    render_own: RenderRgb | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Outer view with the robot's own view set in, and that own view alone.

    Args:
        render_rgb: the renderer.
        scene: what the renderer calls its scene.
        env: environment index.
        base_pos, target_pos: positions in W, m.
        camera: pose (position, optical quaternion) of the robot's camera in W.
        size: width and height of the outer view, pixels.
        camera_fov_deg: vertical field of view of the robot's camera.
        render_own: renderer of the own view, by default the same; it may leave the camera's housing out.

    Returns:
        Outer view with inset [H,W,3] and own view [H/3,W/3,3], uint8.
    """
    width, height = size
    eye, quat = follow_camera(base_pos, target_pos)
    outer = render_rgb(scene, env, eye, quat, width, height, 42.0)
    own = (render_own or render_rgb)(scene, env, *camera, width // 3, height // 3, camera_fov_deg)
    return inset(outer, own), own


def key_steps(free_space: np.ndarray, contact: np.ndarray, lifted: np.ndarray) -> dict[str, int]:
    """Steps that show the five moments of the paper's Figure 3, in order of time.

    Args:
        free_space: whether the whole-body controller alone moves the robot [T].
        contact: whether the hand touches the target [T].
        lifted: whether the target has left its support [T].
    """
    steps = len(free_space)
    touch = int(np.argmax(contact)) if contact.any() else steps - 1
    local = int(np.argmin(free_space)) if not free_space.all() else touch
    local = min(local, touch)
    rise = int(np.argmax(lifted)) if lifted.any() else steps - 1
    picks = [local // 3, (5 * local) // 6, (local + touch) // 2, min(touch + 3, rise), steps - 1]
    return dict(zip(KEY_PHASES, (int(p) for p in np.maximum.accumulate(picks)), strict=True))


def jpeg_bytes(frame: np.ndarray, quality: int = 82) -> bytes:
    """A frame as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(frame, dtype=np.uint8)).save(buffer, "JPEG", quality=quality, optimize=True)
    return buffer.getvalue()


def data_uri(data: bytes, media_type: str) -> str:
    """Bytes as a `data:` URI."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"
