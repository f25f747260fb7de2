"""What the student sees, as a picture: the camera's points from where the camera stands."""

from __future__ import annotations

import numpy as np

HFOV, VFOV = np.radians(87.0), np.radians(58.0)
BACKGROUND = 24
SPECK = 3  # side of a point, px


def sight_image(
    points: np.ndarray, colours: np.ndarray, rot: np.ndarray, pos: np.ndarray, width: int = 232, height: int = 148
) -> np.ndarray:
    """Picture [H,W,3] uint8 of points [P,3] with colours [P,3] uint8, near ones before far ones.

    Args:
        points: in any frame.
        colours: of the points.
        rot, pos: the optical frame (z forward, y down) in that frame, [3,3] and [3].
        width, height: px; the field of view is the D435's.
    """
    image = np.full((height, width, 3), BACKGROUND, np.uint8)
    p = (np.asarray(points, np.float64) - pos) @ rot
    ahead = p[:, 2] > 1e-3
    p, colours = p[ahead], np.asarray(colours)[ahead]
    order = np.argsort(-p[:, 2], kind="stable")
    p, colours = p[order], colours[order]
    column = (p[:, 0] / p[:, 2] / np.tan(HFOV / 2) + 1) / 2 * width
    row = (p[:, 1] / p[:, 2] / np.tan(VFOV / 2) + 1) / 2 * height
    for dy in range(SPECK):
        for dx in range(SPECK):
            x = np.floor(column).astype(int) + dx - SPECK // 2
            y = np.floor(row).astype(int) + dy - SPECK // 2
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            image[y[inside], x[inside]] = colours[inside]
    return image
