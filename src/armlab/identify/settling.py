"""Alternation between the linear parameters of a design and the shape of friction, until both stay.

The shape comes from a grid, judged on held-out blocks; its numbers then by Gauss-Newton steps on all rows,

    tau ~ A theta + sum_k d(A theta)/d(log s_k) log(s_k' / s_k)

so that an estimate that linearises there again has no step left to take, and its covariance holds for the shape too.
"""

from __future__ import annotations

import numpy as np

from armlab.estimation import LinearSolution, least_squares
from armlab.identify.design import Design
from armlab.identify.preparation import Prepared
from armlab.identify.shapes import Chooser, choose_here

__all__ = ["ROBUST", "linearised", "settle", "short_blocks", "solved"]

ROUNDS = 4
STEPS = 6  # of Gauss and Newton
SHARES = (1.0, 0.5, 0.25)  # of a step that are tried
STAYS = 1e-3  # sum of the squared logarithmic steps
VAGUE = 0.3  # formal deviation of the logarithm of a number beyond which a straight line tells nothing of it
TRIMMED = 0.25  # s, blocks of which the method "lts" leaves some out
MOST_BLOCKS = 1000.0  # of them: a triangle is kept for each
HUBER = 1.345
NORMAL_MAD = 0.6744897501960817  # median of |x| for x ~ N(0, 1)
ROBUST = ("irls", "lts")


def settle(
    design: Design, method: str, seed: int = 0, use: np.ndarray | None = None, chooser: Chooser = choose_here
) -> tuple[Design, np.ndarray]:
    """Alternate between the linear parameters and the shape of friction until the shape stays; return both.

    Directions that the log does not tell are no fault here: the last fit judges.

    Parameters
    ----------
    design : with any shapes. method : of `fit_dynamics`. seed : of "lts".
    use : (M,) kept rows to fit to; all when left out. chooser : of `Design.choose_shapes`.
    """
    use = np.ones(len(design.rows), dtype=bool) if use is None else use
    trust = np.repeat(use[:, None].astype(float), len(design.joints), axis=1)
    block = design.data.blocks(short_blocks(design.data))[design.rows]
    theta = solved(design, trust, method).x
    for _ in range(ROUNDS):
        if method in ROBUST:
            trust = _trust(design, theta, block, method, seed) * use[:, None]
        shaped = design.choose_shapes(theta, trust, chooser)
        settled = shaped.shapes.same(design.shapes)
        design, theta = shaped, solved(shaped, trust, method).x
        if settled:
            break
    return _refined(design, theta, trust, method)


def _refined(design: Design, theta: np.ndarray, trust: np.ndarray, method: str) -> tuple[Design, np.ndarray]:
    """Take Gauss-Newton steps of the numbers of the shapes while they lower the residual."""
    cost = _cost(design, theta, trust)
    for _ in range(STEPS):
        sloped = linearised(design, theta, method, trust)
        step = np.where(sloped.layout.slopes, solved(sloped, trust, method).x, 0.0)
        for share in SHARES:
            trial = design.with_shapes(sloped.moved(share * step))
            found = solved(trial, trust, method).x
            lower = _cost(trial, found, trust)
            if lower < cost:
                break
        else:
            break
        design, theta, cost = trial, found, lower
        if float(step @ step) < STAYS**2:
            break
    return design, theta


def _cost(design: Design, theta: np.ndarray, trust: np.ndarray) -> float:
    """Return the sum over joints of the logarithm of the weighted squared residual."""
    power = np.sum((trust * design.residuals(theta)) ** 2, axis=0)
    return float(np.sum(np.log(np.maximum(power, 1e-300))))


def linearised(design: Design, theta: np.ndarray, method: str, trust: np.ndarray | None = None) -> Design:
    """Return the design with slopes of those numbers of the shapes that the log tells.

    Parameters
    ----------
    design : without slopes, at its parameters theta (p,). method : of the fit.
    trust : (M, J) weights of the rows; 1 when left out.
    """
    sloped = design.with_slopes(theta)
    free, sd = sloped.free.copy(), solved(sloped, trust, method).sd[sloped.layout.slopes]
    free[sloped.free] = sd < VAGUE
    return sloped if np.array_equal(free, sloped.free) else design.with_slopes(theta, free)


def short_blocks(data: Prepared) -> float:
    """Return the length of the blocks that "lts" leaves out [s].

    Parameters
    ----------
    data : the record.
    """
    return max(TRIMMED, data.seconds / MOST_BLOCKS)


def solved(design: Design, trust: np.ndarray | None, method: str) -> LinearSolution:
    """Solve for weighted rows; the smallest parameters where the log does not tell them.

    Parameters
    ----------
    design : the problem. trust : (M, J) weights of the rows; 1 when left out. method : of `fit_dynamics`.
    """
    rows = design.stream(np.zeros(len(design.rows), dtype=int), trust)
    plain = "ols" if method == "ols" else "wls"
    return least_squares(rows, design.layout.names, method=plain, lower=design.layout.lower, max_condition=np.inf)


def _trust(design: Design, theta: np.ndarray, block: np.ndarray, method: str, seed: int) -> np.ndarray:
    """Return factors (M, J) of the rows that keep outliers from the choice of shape."""
    if method == "lts":
        found = least_squares(design.stream(block), design.layout.names, method="lts", seed=seed, max_condition=np.inf)
        return np.repeat(found.kept[block][:, None].astype(float), len(design.joints), axis=1)
    e = np.abs(design.residuals(theta))
    limit = HUBER / NORMAL_MAD * np.median(e, axis=0)
    return np.sqrt(np.divide(limit, e, out=np.ones_like(e), where=e > limit))
