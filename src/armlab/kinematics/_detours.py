"""Detours of redundant arms: earlier rows of a path chosen anew, so that the path does not break where it did.

Going from pose to pose by the least motion, a redundant arm can end in a part of its self-motion that the next poses
have no more, while another part goes on. The way there is found from behind: from solutions at the break the path is
followed backwards, each row as near as it can be to the row that was there. Where both meet, the rows behind are
replaced. (How self-motions part: Burdick, On the inverse kinematics of redundant manipulators, ICRA 1989.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from armlab.robots import Robot

__all__ = ["Rows", "with_detours"]

ATTEMPTS = 10  # breaks of a path that detours are looked for
CANDIDATES = 32  # starts of solutions at a break: one half near the row before, the other anywhere
SPREAD = 0.6  # rad: standard deviation of those near the row before
LOOK_BACK, LOOK_AHEAD = 1000, 1000  # rows
NEAR = 1  # the objective of the kernel: near a posture
TOGETHER = 1e-6  # rad: postures that are one


class Rows(NamedTuple):
    """What the kernel returns: postures (N, n), errors (N, 3), counts (N, 3) (steps, status, other branch)."""

    q: np.ndarray
    errors: np.ndarray
    counts: np.ndarray


Follow = Callable[[np.ndarray, np.ndarray, int, np.ndarray | None, np.ndarray | None], Rows]
"""(T, q0, objective, its reference, its scale) -> rows"""
Solve = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(T (4, 4), q0 (k, n)) -> solutions (k, n), which of them are some (k,)"""


def with_detours(robot: Robot, T: np.ndarray, rows: Rows, follow: Follow, solve: Solve) -> Rows:
    """Return `rows` with detours around the breaks for which there are some, if fewer rows break then.

    Parameters
    ----------
    robot : the arm, with joints to spare.
    T : (N, 4, 4) poses.
    rows : followed along T.
    follow, solve : the kernels with everything else decided.
    """
    rng = np.random.default_rng(0)
    given_up = 0  # breaks up to this row stay
    best = rows
    for _ in range(ATTEMPTS):
        broken = rows.counts[:, 1] != 0
        first = np.flatnonzero(broken[1:] & ~broken[:-1]) + 1
        first = first[first > given_up]
        if not len(first):
            break
        given_up = k = int(first[0])
        low, high = robot.q_min, robot.q_max
        before = rows.q[k - 1]
        near = before + SPREAD * rng.standard_normal((CANDIDATES // 2, robot.n))
        anywhere = rng.uniform(np.maximum(low, before - np.pi), np.minimum(high, before + np.pi), near.shape)
        detour = _best(T, rows, k, follow, solve(T[k], np.clip(np.concatenate([near, anywhere]), low, high)))
        if detour is not None:
            rows = _replaced(rows, k, detour, follow(T[k:], detour.q[-1], 0, None, None))
            best = min(best, rows, key=lambda found: np.count_nonzero(found.counts[:, 1]))
    return best


def _best(T: np.ndarray, rows: Rows, k: int, follow: Follow, solutions: tuple[np.ndarray, np.ndarray]) -> Rows | None:
    """Return rows that end at row k and begin where they meet the path; of several those that lead furthest."""
    best, furthest, seen = None, -1, []
    before = slice(k - 1, max(0, k - LOOK_BACK) - 1 if k > LOOK_BACK else None, -1)
    for q in solutions[0][solutions[1]]:
        if any(np.abs(q - other).max() < 1e-3 for other in seen):
            continue
        seen.append(q)
        wishes = np.concatenate([q[None], rows.q[before]])
        back = follow(np.concatenate([T[k : k + 1], T[before]]), q, NEAR, wishes, np.ones(len(q)))
        whole = np.logical_and.accumulate(back.counts[:, 1] == 0)
        meets = np.flatnonzero(whole & (np.abs(back.q - wishes).max(axis=1) < TOGETHER))
        if len(meets) < 2:  # the first is its own wish
            continue
        ahead = follow(T[k : k + LOOK_AHEAD], q, 0, None, None).counts[:, 1]
        goes = int(np.argmax(ahead != 0)) if ahead.any() else len(ahead)
        if goes > furthest:
            best, furthest = Rows(*(part[meets[1] :: -1] for part in back)), goes
    return best


def _replaced(rows: Rows, k: int, detour: Rows, ahead: Rows) -> Rows:
    """Return the rows with the detour up to row k, and what follows from it."""
    start = k - len(detour.q) + 1
    return Rows(*(np.concatenate([old[:start], new, rest[1:]]) for old, new, rest in zip(rows, detour, ahead)))
