"""A test camera in front of an arm, and the positions of the tool balls in its images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from armlab.lie import quaternion
from armlab.live.scene import TOOL_COLOR, rgb

WIDTH, HEIGHT, FOV = 600, 400, np.deg2rad(45.0)
POSITION, LOOK_AT = np.array([1.6, 0.0, 0.9]), np.array([0.2, 0.0, 0.35])
PICTURES = 12  # until the page has drawn what it was sent


def axes() -> np.ndarray:
    z = (LOOK_AT - POSITION) / np.linalg.norm(LOOK_AT - POSITION)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def projected(points: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis((points - POSITION) @ axes(), -1, 0)
    focal = HEIGHT / 2.0 / np.tan(FOV / 2.0)
    return np.stack([WIDTH / 2.0 + focal * x / z, HEIGHT / 2.0 + focal * y / z], axis=-1)


def taken(server: Any, path: Path) -> np.ndarray:
    import imageio.v3 as iio

    client = next(iter(server.get_clients().values()))
    view = {"wxyz": quaternion.from_matrix(axes()), "position": POSITION, "fov": FOV}
    picture = client.get_render(HEIGHT, WIDTH, **view, transport_format="png", timeout=120.0)
    iio.imwrite(path, picture)
    return picture


def off(picture: np.ndarray, at: np.ndarray) -> float:
    """Return the distance of the tool ball from its expected position [pixels]; infinite if it is not found."""
    color = np.array(rgb(TOOL_COLOR), dtype=float)
    pixels = picture[..., :3].astype(float)
    shade = pixels @ color / (color @ color)  # light changes the length, not the direction
    alike = np.linalg.norm(pixels - shade[..., None] * color, axis=-1) < 0.12 * np.linalg.norm(pixels, axis=-1)
    rows, columns = np.nonzero(alike & (shade > 0.3))
    there = np.hypot(columns - at[0], rows - at[1]) < 40.0
    if there.sum() < 8:
        return np.inf
    return float(np.hypot(columns[there].mean() - at[0], rows[there].mean() - at[1]))


def seen(server: Any, points: list[np.ndarray], path: Path) -> float:
    """Return the largest distance of the tools from their expected positions, once they arrive or time is up."""
    worst = np.inf
    for _ in range(PICTURES):
        picture = taken(server, path)
        worst = max(off(picture, projected(point)) for point in points)
        if worst < 6.0:
            break
    return worst
