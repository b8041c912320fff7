"""The shape of friction: what is not linear in it, and which terms each joint has, chosen on held-out blocks.

    F_f = viscous qd + coulomb s + offset [+ asymmetry |s|] [+ stribeck s exp(-(qd / v_s)^2)] [+ root s sqrt(|qd|)]

s is the presliding state z of distance delta, or tanh(qd / v_t). Terms in brackets are there where they win; asymmetry
is told as two Coulomb torques, one for each direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

__all__ = [
    "COLUMNS",
    "DELTAS",
    "SMOOTH_SPEEDS",
    "STRIBECK_SPEEDS",
    "TERMS",
    "Shapes",
    "choose",
    "mixing",
    "term_names",
]

DELTAS = np.geomspace(1e-4, 1e-2, 7)  # rad
SMOOTH_SPEEDS = np.array([0.005, 0.01, 0.02, 0.05, 0.1])  # rad/s
STRIBECK_SPEEDS = np.array([0.02, 0.05, 0.1, 0.3])  # rad/s
REFINEMENTS = (1.5, 1.25, 1.12, 1.06, 1.03, 1.015)  # factors tried both ways after the grid
GAIN = 0.01  # of the squared held-out error: a term that wins less is left out
DEFAULT_SPEED = 2  # of STRIBECK_SPEEDS, for joints without that term
EXACT = 1e-12  # squared error, relative to the torque, that is rounding
# All columns of a joint, in their order; the last two where the gears are known.
COLUMNS = ("viscous", "coulomb+", "coulomb-", "offset", "stribeck", "root", "ripple cos", "ripple sin")
# Which of asymmetry, Stribeck and root a joint may have, fewest first.
TERMS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]], dtype=bool)

Shaped = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shape of the friction of all joints; vectors are (n,).

    Attributes
    ----------
    delta : presliding distance [rad]. smooth : v_t [rad/s], 0 where the sign is the presliding state.
    speed : v_s of Stribeck's term [rad/s]. terms : (n, 3) bool: asymmetry, Stribeck, root.
    """

    delta: np.ndarray
    smooth: np.ndarray
    speed: np.ndarray
    terms: np.ndarray

    @classmethod
    def start(cls, n: int) -> Shapes:
        """Return presliding over 1e-3 rad with all terms but the root, for n joints."""
        return cls(np.full(n, 1e-3), np.zeros(n), np.full(n, 0.1), np.tile([True, True, False], (n, 1)))

    def same(self, other: Shapes) -> bool:
        """Return whether the other differs by less than 10 %, in the same terms."""
        kinds = np.array_equal(self.terms, other.terms) and np.array_equal(self.smooth > 0, other.smooth > 0)
        mine, others = (np.stack([s.delta, s.smooth, s.speed]) for s in (self, other))
        return bool(kinds and np.allclose(mine, others, rtol=0.1))


def term_names(terms: np.ndarray, ripple: bool) -> tuple[str, ...]:
    """Return the names of the columns that a joint with these terms (3,) has; `ripple` where the gears are known."""
    names = np.array(COLUMNS if ripple else COLUMNS[:6])
    picks = [names[column > 0] for column in mixing(terms, len(names)).T]
    return tuple(str(pick[0]) if len(pick) == 1 else "coulomb" for pick in picks)


def mixing(terms: np.ndarray, width: int) -> np.ndarray:
    """Return the matrix (width, k) from all columns of a joint to those that it has.

    Parameters
    ----------
    terms : (3,) asymmetry, Stribeck, root. width : number of all columns, see `COLUMNS`.
    """
    asymmetric, stribeck, root = terms
    eye = np.eye(width)
    coulomb = eye[:, 1:3] if asymmetric else eye[:, 1:3].sum(axis=1, keepdims=True)
    rest = [eye[:, 4 + k : 5 + k] for k, present in enumerate((stribeck, root)) if present]
    return np.hstack([eye[:, :1], coulomb, eye[:, 3:4], *rest, eye[:, 6:]])


@dataclass(eq=False)
class _Search:
    """Held-out errors of shapes, tried one after the other."""

    shaped: Shaped
    fixed: np.ndarray
    target: np.ndarray
    trust: np.ndarray
    odd: np.ndarray

    def scores(self, delta: np.ndarray, smooth: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the held-out error (n, S, 8) of shapes with speeds (S, n), relative to the torque, for all TERMS."""
        columns = self.shaped(delta, smooth, speeds)
        n, S = columns.shape[1], len(speeds)
        out = np.empty((n, S, len(TERMS)))
        for i in range(n):
            fixed = self.fixed[:, i]
            A = np.column_stack([fixed[:, :1], columns[:, i, :2], fixed[:, 1:2], columns[:, i, 2:], fixed[:, 2:]])
            A, y = A * self.trust[:, i, None], self.target[:, i] * self.trust[:, i]
            halves = [_sums(A[half], y[half]) for half in (self.odd, ~self.odd)]
            ripple = list(range(5 + S, A.shape[1]))
            picks = np.array([[0, 1, 2, 3, 5 + s, 4, *ripple] for s in range(S)])
            out[i] = _held_out(halves, picks)
        return out


def _sums(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    return A.T @ A, A.T @ y, float(y @ y)


def _held_out(halves: list[tuple[np.ndarray, np.ndarray, float]], picks: np.ndarray) -> np.ndarray:
    """Return the squared error of each half of the blocks by the parameters of the other, over the torque's (S, 8).

    Parameters
    ----------
    halves : of each half A^T A, A^T y and y^T y. picks : (S, w) columns of A that each speed of Stribeck has.
    """
    w = picks.shape[1]
    T = np.zeros((len(TERMS), w, w))  # absent columns are zero and keep parameters of zero
    for k, terms in enumerate(TERMS):
        mixed = mixing(terms, w)
        T[k, :, : mixed.shape[1]] = mixed
    grams = [(G[picks[:, :, None], picks[:, None, :]][:, None], v[picks][:, None, :, None]) for G, v, _ in halves]
    error = np.zeros((len(picks), len(TERMS)))
    for (G, v), (H, u), power in ((*grams, halves[1][2]), (*grams[::-1], halves[0][2])):
        A, b = T.transpose(0, 2, 1) @ G @ T, T.transpose(0, 2, 1) @ v
        scale = np.sqrt(np.diagonal(A, axis1=2, axis2=3))
        scale = np.where(scale > 0, scale, 1.0)[..., None]
        A = A / (scale * np.swapaxes(scale, 2, 3))
        diagonal = np.arange(w)
        A[..., diagonal, diagonal] = 1.0 + EXACT
        x = T @ (np.linalg.solve(A, b / scale) / scale)
        error += (power - 2.0 * np.swapaxes(u, 2, 3) @ x + np.swapaxes(x, 2, 3) @ H @ x)[..., 0, 0]
    total = halves[0][2] + halves[1][2]
    return np.maximum(error / total if total > 0 else error, EXACT)


def choose(shaped: Shaped, fixed: np.ndarray, target: np.ndarray, odd: np.ndarray, trust: np.ndarray) -> Shapes:
    """Choose the shape of each joint's friction: fitted to the odd blocks of time, judged on the even ones, and back.

    Presliding distance or v_t, the speed of Stribeck's term, and which terms there are come from a grid; of all that
    come within 1 % of the smallest squared error the one with the fewest terms wins, with presliding before tanh. Its
    numbers are then refined.

    Parameters
    ----------
    shaped : (delta (n,), smooth (n,), speeds (S, n)) -> columns (M, n, 3 + S): s+, s-, root, Stribeck of each speed.
    fixed : (M, n, 2 or 4) columns viscous, offset, and ripple where the gears are known.
    target : (M, n) torque that friction has to explain.
    odd : (M,) rows in odd blocks. trust : (M, n) weights of the rows, 0 to leave one out.
    """
    search = _Search(shaped, fixed, target, trust, odd)
    n = target.shape[1]
    every = np.repeat(STRIBECK_SPEEDS[:, None], n, axis=1)
    trials = [(np.full(n, delta), np.zeros(n)) for delta in DELTAS]
    trials += [(np.full(n, DELTAS[3]), np.full(n, smooth)) for smooth in SMOOTH_SPEEDS]
    scores = np.stack([search.scores(*trial, every) for trial in trials])  # (trial, n, speed, terms)
    picked = [_pick(scores[:, i]) for i in range(n)]
    best = np.array([scores[t, i, s, k] for i, (t, s, k) in enumerate(picked)])
    shapes = Shapes(
        delta=np.array([trials[t][0][i] for i, (t, _, _) in enumerate(picked)]),
        smooth=np.array([trials[t][1][i] for i, (t, _, _) in enumerate(picked)]),
        speed=STRIBECK_SPEEDS[[s for _, s, _ in picked]],
        terms=TERMS[[k for _, _, k in picked]],
    )
    shapes = _refine(search, shapes, best)
    scores = search.scores(shapes.delta, shapes.smooth, shapes.speed[None])[:, 0]
    simplest = np.argmax(scores <= (1.0 + GAIN) * scores.min(axis=1, keepdims=True), axis=1)
    shapes = replace(shapes, terms=TERMS[simplest])  # on the grid a term may stand in for a width between two points
    return _refine(search, shapes, scores[np.arange(n), simplest])


def _pick(scores: np.ndarray) -> tuple[int, int, int]:
    """Return (trial, speed, terms) of the simplest shape of one joint that is good enough, of (trial, speed, terms)."""
    kinds = np.arange(len(scores)) < len(DELTAS)
    choices = []
    for k, terms in enumerate(TERMS):
        for kind in (kinds, ~kinds):
            part = np.where(kind[:, None], scores[:, :, k], np.inf)
            t, s = divmod(int(np.argmin(part)), part.shape[1])
            choices.append((float(part[t, s]), (t, s if terms[1] else DEFAULT_SPEED, k)))
    limit = (1.0 + GAIN) * min(score for score, _ in choices)
    return next(choice for score, choice in choices if score <= limit)


def _refine(search: _Search, shapes: Shapes, best: np.ndarray) -> Shapes:
    """Try factors on distance or speed of the sign and on Stribeck's speed; keep what lowers the held-out error."""
    joints, soft = np.arange(len(best)), shapes.smooth > 0
    which = [int(np.flatnonzero((terms == TERMS).all(axis=1))[0]) for terms in shapes.terms]
    for factor in (f for step in REFINEMENTS for f in (step, 1.0 / step)):
        for of_sign, of_bump in ((factor, 1.0), (1.0, factor)):
            delta, smooth = np.where(soft, 1.0, of_sign) * shapes.delta, of_sign * shapes.smooth
            speed = of_bump * shapes.speed
            score = search.scores(delta, smooth, speed[None])[joints, 0, which]
            better = score < best
            best = np.where(better, score, best)
            shapes = replace(
                shapes,
                delta=np.where(better, delta, shapes.delta),
                smooth=np.where(better, smooth, shapes.smooth),
                speed=np.where(better, speed, shapes.speed),
            )
    return shapes
