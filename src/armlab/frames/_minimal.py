"""Features through as few points as make one, many at once: squared distances of all points from each of them.

Sets that make no feature, as three points in a line, give NaN or infinity.
"""

from __future__ import annotations

import numpy as np

__all__ = ["circles", "lines", "planes", "spheres"]


def planes(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the planes through sets (S, 3, 3)."""
    n = np.cross(sets[:, 1] - sets[:, 0], sets[:, 2] - sets[:, 0])
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.divide(n, length, out=np.full_like(n, np.nan), where=length > 0)
    return (n @ p.T - np.sum(n * sets[:, 0], axis=1)[:, None]) ** 2


def lines(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the lines through sets (S, 2, 3)."""
    v = sets[:, 1] - sets[:, 0]
    length = np.linalg.norm(v, axis=1, keepdims=True)
    v = np.divide(v, length, out=np.full_like(v, np.nan), where=length > 0)
    away = p - sets[:, :1]
    return np.sum(np.cross(away, v[:, None]) ** 2, axis=2)


def circles(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the circles through sets (S, 3, 3)."""
    a, b = sets[:, 1] - sets[:, 0], sets[:, 2] - sets[:, 0]
    n = np.cross(a, b)
    twice = np.sum(n**2, axis=1, keepdims=True)
    aa, bb = np.sum(a**2, axis=1, keepdims=True), np.sum(b**2, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_centre = (np.cross(n, a) * bb + np.cross(b, n) * aa) / (2.0 * twice)
        unit = n / np.sqrt(twice)
        away = p - (sets[:, 0] + to_centre)[:, None]
        z = np.einsum("snk,sk->sn", away, unit)
        rho = np.sqrt(np.maximum(np.sum(away**2, axis=2) - z**2, 0.0))
        return (rho - np.linalg.norm(to_centre, axis=1)[:, None]) ** 2 + z**2


def spheres(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the spheres through sets (S, 4, 3)."""
    edges = sets[:, 1:] - sets[:, :1]
    volume = np.abs(np.linalg.det(edges)) > 1e-12 * np.linalg.norm(edges, axis=2).prod(axis=1)
    squares = np.full((len(sets), len(p)), np.nan)
    to_centre = np.linalg.solve(edges[volume], 0.5 * np.sum(edges[volume] ** 2, axis=2)[..., None])[..., 0]
    away = p - (sets[volume, 0] + to_centre)[:, None]
    squares[volume] = (np.linalg.norm(away, axis=2) - np.linalg.norm(to_centre, axis=1)[:, None]) ** 2
    return squares
