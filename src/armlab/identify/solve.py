"""Alternating estimation of the linear parameters and the friction structure until convergence.

The structure comes from a grid search on held-out blocks. Its nonlinear parameters are then refined by Gauss-Newton
steps on all rows:

    tau ~ A theta + sum_k d(A theta)/d(log s_k) log(s_k' / s_k)

At convergence, the linearised problem yields no further step, and its covariance includes the nonlinear parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armlab.estimation import BlockSums, block_bootstrap, least_squares
from armlab.estimation.linear_problem import LinearSolution
from armlab.estimation.robust import HUBER, NORMAL_MAD, effective_samples, shrinkage
from armlab.identify.friction_structure import FOLDS, IDENTIFIED, TERMS, Chooser, choose_here, mixing
from armlab.identify.record import Record
from armlab.identify.regression import BLOCK, Design
from armlab.models.friction import FRICTION_TERMS

# Least squares with one unknown gain per joint, ``y_i = (1 + g_i) A_i x + e_i``, ``g_i ~ N(0, s^2)``: Gauss-Newton on
# sums per joint and block of time, with the gains eliminated:
#
#     (H - sum_i u_i u_i^T / d_i) dx = -(r - sum_i u_i e_i / d_i),   dg_i = -(e_i + u_i dx) / d_i
#     H = sum k^2 G_i,   u_i = k G_i x,   d_i = x^T G_i x + 1 / s^2,   k = 1 + g_i


STEPS, SETTLED = 30, 1e-9
EXACT = 1e-5  # residuals below this fraction of the measurements are rounding


@dataclass(frozen=True, eq=False)
class GainProblem:
    """Least-squares sums of a regression with unknown gains.

    `sums`: (B, n, p + 1, p + 1) of ``[A y]^T [A y]`` per block and joint, weighted by 1 / variance and by the
    joint's fraction of effective samples. `weights`: (n,) weight of each joint's squared residuals [1 / (N m)^2].
    `gain_sd`: prior standard deviation of the gains; 0 for known gains of 1. `stretch`: ratio of the scatter of a
    robust solution to the scatter of its weighted sums.
    """

    sums: np.ndarray
    weights: np.ndarray
    gain_sd: float
    stretch: float = 1.0

    @classmethod
    def of(cls, solution: LinearSolution, residuals: np.ndarray, gains: np.ndarray, gain_sd: float) -> GainProblem:
        """Build the sums from a solution for rows ``(1 + gains_i) A_i``."""
        factors, p = solution.factors, len(solution.x)
        share = np.array([effective_samples(column) for column in residuals.T]) / len(residuals)
        size = np.array([np.linalg.norm(R[:, :, -1]) for R in factors.R]) / np.sqrt(len(residuals))
        weights = share / np.maximum(1.0 / solution.weights, EXACT * size) ** 2
        sums = np.zeros((len(factors.rows), len(weights), p + 1, p + 1))
        for i, (R, columns) in enumerate(zip(factors.R, factors.columns)):
            at = np.append(columns, p)
            R = R / np.append(np.full(len(columns), 1.0 + gains[i]), 1.0)
            sums[:, i, at[:, None], at] = weights[i] * R.transpose(0, 2, 1) @ R
        return cls(sums, weights, gain_sd, solution.stretch)

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Solve for x (p,) and the gains minus 1 (n,)."""
        p = self.sums.shape[-1] - 1
        total = self.sums.sum(axis=0)
        scale = np.sqrt(np.einsum("iaa->a", total[:, :p, :p]))
        scale = np.where(scale > 0, scale, 1.0)
        G, b = total[:, :p, :p] / np.outer(scale, scale), total[:, :p, p] / scale
        x, g = np.linalg.solve(G.sum(axis=0), b.sum(axis=0)), np.zeros(len(b))
        for _ in range(STEPS):
            S, u, d = self._normal(G, x, 1.0 + g)
            short = u - b  # k G x - b
            e = short @ x + (g / self.gain_sd**2 if self.gain_sd else 0.0)
            dx = -np.linalg.solve(S, (1.0 + g) @ short - (e / d) @ u)
            g = g - (e + u @ dx) / d
            x = x + dx
            if np.abs(dx).max() <= SETTLED * np.abs(x).max():
                break
        return x / scale, g

    def information(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the information matrix (p, p) of x for unknown gains."""
        return self._normal(self.sums.sum(axis=0)[:, :-1, :-1], x, 1.0 + g)[0]

    def gain_covariance(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the covariance (n, n) of the gains for unknown x."""
        G, k = self.sums.sum(axis=0)[:, :-1, :-1], 1.0 + g
        _, u, d = self._normal(G, x, k)
        H = np.tensordot(k * k, G, 1)
        scale = np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
        projected = np.linalg.solve(H / np.outer(scale, scale), (u / scale).T)
        cov = np.linalg.inv(np.diag(d) - (u / scale) @ projected)
        return 0.5 * (cov + cov.T)

    def response(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the sensitivity of x to the sums ``weights_i A_i^T e_i`` of each joint, (n, p, p)."""
        S, through, _ = self._reduced(x, g)
        return np.linalg.solve(S, through)

    def covariance(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of x, from the scatter of the blocks and the gains."""
        S, through, pushes = self._reduced(x, g)
        B, A = len(self.sums), self.sums[:, :, :-1, :-1]
        left = self.sums[:, :, :-1, -1] - (1.0 + g)[:, None] * (A @ x)  # A^T e per block and joint
        gradients = np.einsum("iab,jib->ja", through, left)
        white = np.einsum("iab,ibc,idc->ad", through, A.sum(axis=0), through)  # covariance for white e
        root = np.linalg.cholesky(white)
        scores = np.linalg.solve(root, (gradients - gradients.mean(axis=0)).T).T
        chance = shrinkage(scores)
        scatter = self.stretch**2 * B / (B - 1.0) * scores.T @ scores
        scatter = (1.0 - chance) * scatter + chance * np.trace(scatter) / len(x) * np.eye(len(x))
        sides = np.linalg.solve(S, np.hstack([root @ np.linalg.cholesky(scatter), pushes]))
        return sides @ sides.T

    def _reduced(self, x: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the information matrix (p, p), and the sensitivity of x to joint sums (n, p, p) and gains (p, n)."""
        k = 1.0 + g
        S, u, d = self._normal(self.sums.sum(axis=0)[:, :-1, :-1], x, k)
        through = k[:, None, None] * np.eye(len(x)) - u[:, :, None] * x / d[:, None, None]
        return S, through, (u / d[:, None]).T / self.gain_sd if self.gain_sd else np.zeros((len(x), 0))

    def _normal(self, G: np.ndarray, x: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the information matrix of x (p, p), and the u (n, p) and d (n,) of the eliminated gains."""
        Gx = G @ x
        u = k[:, None] * Gx
        d = Gx @ x + (1.0 / self.gain_sd**2 if self.gain_sd else np.inf)
        return np.tensordot(k * k, G, 1) - (u / d[:, None]).T @ u, u, d


ROUNDS = 4
SHAPE_STEPS = 6  # Gauss-Newton steps
SHARES = (1.0, 0.5, 0.25)  # fractions of a step in the line search
STAYS = 1e-3  # convergence limit on the norm of the logarithmic steps
VAGUE = 0.3  # formal SD of a logarithm above which the nonlinear parameter is not identified
TRIMMED = 0.25  # s, blocks for the method "lts"
MOST_BLOCKS = 1000.0  # largest number of these blocks, because each stores a triangular factor
ROBUST = ("irls", "lts")


def alternate(
    design: Design,
    method: str,
    seed: int = 0,
    chooser: Chooser = choose_here,
    use: np.ndarray | None = None,
    again: bool = False,
) -> tuple[Design, np.ndarray, np.ndarray]:
    """Estimate the linear parameters and the friction structure alternately until convergence.

    Return the design, its parameters (p,) and the weights (M, J) of the rows, for use as arguments of `refined`.

    Undetermined directions are accepted at this stage and checked in the final fit. `use`: (M,) kept rows used in the
    fit. `again`: whether the structure has been selected before.
    """
    used = np.ones((len(design.rows), 1)) if use is None else use[:, None].astype(float)
    trust = np.ones_like(design.tau) * used
    block = design.data.blocks(short_blocks(design.data))[design.rows]
    theta = solved(design, trust, method).x
    for _ in range(ROUNDS):
        if method in ROBUST:
            trust = _trust(design, theta, block, method, seed) * used
        shaped = design.choose_structure(theta, trust, chooser, again)
        again = True
        settled = shaped.structure.same(design.structure)
        design, theta = shaped, solved(shaped, trust, method).x
        if settled:
            break
    return design, theta, trust


def refined(design: Design, theta: np.ndarray, trust: np.ndarray, method: str) -> tuple[Design, np.ndarray]:
    """Take Gauss-Newton steps in the nonlinear parameters while they reduce the residual."""
    cost = _cost(design, theta, trust)
    for _ in range(SHAPE_STEPS):
        sloped, solution = linearised(design, theta, method, trust)
        step = np.where(sloped.layout.slopes, solution.x, 0.0)
        for share in SHARES:
            trial = design.with_structure(sloped.moved(share * step))
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


def linearised(
    design: Design, theta: np.ndarray, method: str, trust: np.ndarray | None = None
) -> tuple[Design, LinearSolution]:
    """Return the design with derivative columns of the identified nonlinear parameters, and its solution."""
    sloped = design.with_slopes(theta)
    solution = solved(sloped, trust, method)
    free = sloped.free.copy()
    free[sloped.free] = solution.sd[sloped.layout.slopes] < VAGUE
    if np.array_equal(free, sloped.free):
        return sloped, solution
    sloped = design.with_slopes(theta, free)
    return sloped, solved(sloped, trust, method)


def short_blocks(data: Record) -> float:
    """Return the block length [s] for the "lts" method."""
    return max(TRIMMED, data.seconds / MOST_BLOCKS)


def solved(design: Design, trust: np.ndarray | None, method: str) -> LinearSolution:
    """Solve the weighted rows, with minimum norm along undetermined directions."""
    rows = design.stream(np.zeros(len(design.rows), dtype=int), trust)
    plain = "ols" if method == "ols" else "wls"
    layout = design.layout
    return least_squares(rows, layout.names, method=plain, lower=layout.lower, upper=layout.upper, max_condition=np.inf)


BANDS = (12.0, 6.0)  # Hz, alternative cut-offs
YARDSTICK = 10.0  # Hz, band in which cut-offs are compared
PARTS = 1.0  # s, segments used alternately for fitting and validation
NEARLY = 1.02  # ratio to the smallest residual within which the highest cut-off is selected


def best_cutoff(design: Design, method: str) -> tuple[float, str]:
    """Return the cut-off [Hz] of the regression (at most that of the design) and the reason.

    Acceleration noise biases the parameters and grows with the cut-off. For each cut-off, the model is fitted to half
    the time segments and evaluated on the other half, always in the same band. The highest cut-off within 2 % of the
    best is selected.
    """
    highest = design.decimation.cutoff
    corners = [highest, *(corner for corner in BANDS if corner < highest)]
    if len(corners) == 1:
        return highest, "a tenth of the sampling rate"
    odd = design.data.blocks(PARTS)[design.rows] % 2
    halves = [odd, 1 - odd]
    judged = design.smoothed(min(YARDSTICK, highest))
    power = []
    for corner in corners:
        fitted = design.smoothed(corner) if corner < highest else design
        found = [solved(fitted, np.ones_like(design.tau) * half[:, None], method).x for half in halves]
        power.append(sum(half @ judged.residuals(theta) ** 2 for half, theta in zip(halves[::-1], found)))
    size = np.exp(0.5 * np.mean(np.log(np.maximum(power, 1e-300)), axis=1))
    best = int(np.argmax(size <= NEARLY * size.min()))
    listed = ", ".join(f"{100 * (s / size[best] - 1):+.1f} % at {corner:g} Hz" for s, corner in zip(size, corners))
    return corners[best], f"held-out residual below {min(YARDSTICK, highest):g} Hz: {listed}"


def _trust(design: Design, theta: np.ndarray, block: np.ndarray, method: str, seed: int) -> np.ndarray:
    """Return row weights (M, J) that exclude outliers from the structure selection."""
    if method == "lts":
        found = least_squares(design.stream(block), design.layout.names, method="lts", seed=seed, max_condition=np.inf)
        return np.repeat(found.kept[block][:, None].astype(float), len(design.joints), axis=1)
    e = np.abs(design.residuals(theta))
    limit = HUBER / NORMAL_MAD * np.median(e, axis=0)
    return np.sqrt(np.divide(limit, e, out=np.ones_like(e), where=e > limit))


# Torque gains: the torque scale of a joint may be wrong by several percent, ``g_i ~ N(1, 0.1^2)``. The common scale
# factor of all gains is not identifiable from the arm alone, so it is determined by the prior.


GAIN_SD = 0.1
GAIN_ROUNDS = 2  # class weights depend on the gains
MAX_CONDITION = 1e4  # largest condition number of a log that determines the parameters


def calibrated(
    design: Design, method: str, known: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[Design, np.ndarray, np.ndarray]:
    """Return a design with calibrated torque gains, its parameters (p,), and the covariance (J, J) of the gains.

    If the log does not determine the parameters, the gains are unchanged, and the final fit reports the problem.
    """
    if known is not None:
        gains, cov = known[0][design.joints], known[1][np.ix_(design.joints, design.joints)]
        design = design.with_gains(gains)
        return design, solved(design, None, method).x, cov
    cov = GAIN_SD**2 * np.eye(len(design.joints))
    for _ in range(GAIN_ROUNDS):
        solution = solved(design, None, method)
        if not solution.excitation.condition < MAX_CONDITION:
            return design, solution.x, cov
        problem = GainProblem.of(
            as_read(solution, design.gains), design.residuals(solution.x), design.gains - 1, GAIN_SD
        )
        x, g = problem.solve()
        design, cov = design.with_gains(1.0 + g), problem.gain_covariance(x, g)
    return design, solved(design, None, method).x, cov


def as_read(solution: LinearSolution, gains: np.ndarray) -> LinearSolution:
    """Return the solution for the measured torque, with both sides multiplied by the gains."""
    factors = replace(solution.factors, R=tuple(k * R for k, R in zip(gains, solution.factors.R)))
    return replace(solution, factors=factors, weights=solution.weights / gains)


def gain_share(solution: LinearSolution, gain_cov: np.ndarray) -> np.ndarray:
    """Return the contribution of unknown gains to the covariance (p, p) of the parameters.

    A gain error g gives a torque error -g: ``dx = -sum_i (A^T W A)^-1 w_i^2 A_i^T y_i g_i``.
    """
    pushed = np.zeros((len(solution.x), len(gain_cov)))
    parts = zip(solution.factors.R, solution.factors.columns, solution.weights)
    for i, (R, columns, weight) in enumerate(parts):
        kept = R[solution.kept]
        pushed[columns, i] = weight**2 * np.einsum("bka,bk->a", kept[:, :, :-1], kept[:, :, -1])
    response = solution.basis @ (solution.basis.T @ pushed)
    cov = response @ gain_cov @ response.T
    return 0.5 * (cov + cov.T)


# Friction contributions to the covariance that short time blocks miss: drift along the log, and rival structures.
#
# The block bootstrap covers changes between neighbouring blocks of half a second. Offset drift and warm-up are slower,
# and another log may select other friction terms; both effects are added to the covariance.
#
# Drift. With the solution fixed, a scale of all friction and an offset per joint are fitted to each half of the log.
# The squared difference between the halves, minus its sampling variance, is pooled over the joints relative to their
# friction torque, because a single joint gives only one degree of freedom. Friction follows the gear temperature, which
# changes over minutes, so its change within a log is a trend: the next log of this length differs by twice the
# difference between the halves. Offsets are random walks, for which the factor is sqrt(2). Each log contributes half of
# this variance. The leakage of a linear drift into other parameters is added. The bootstrap uses torques without the
# drift, which it would otherwise treat as noise in every direction.
#
# Structures. Rival friction structures are weighted by exp(-t^2 / 2), with t the excess of their held-out squared error
# over the best, in standard deviations of that excess between blocks. The parameter change v_k of each rival adds a
# rank-one term to the covariance: ``sum_k w_k v_k v_k^T``.


DRIFTS = ("friction", "offset")  # scale of all friction of a joint; constant torque
AHEAD = np.array([4.0, 2.0])  # ratio of variances between logs and between halves: for a trend, for a random walk
POOLING = 30  # iterations of the pooled variance
RIDGE = 1e-6  # ridge relative to a column's power, in case half of the log does not determine a drift


def covariance(
    design: Design, solution: LinearSolution, length: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the covariance (p, p) for known gains, the drift covariance, and the torque variance (J,) due to drift.

    `length` blocks form a segment. The drift covariance and torque variance describe the change between this log and
    the next.
    """
    drift, leaked, torque, steady = _without_drift(design, solution, length)
    drawn = block_bootstrap(BlockSums.of(steady), seed=seed, length=length).cov
    return drawn + drift + leaked + _structure_share(design, solution), drift, torque


def _without_drift(
    design: Design, solution: LinearSolution, length: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, LinearSolution]:
    """Return the covariances (p, p) of the drift and of its leakage, the torque variance due to drift, and a drift-free
    solution."""
    found = [_drifts(design, solution, length, i) for i in range(len(design.joints))]
    difference, variance = (np.array(part) for part in list(zip(*found))[:2])
    pooled = np.zeros(len(DRIFTS))
    for _ in range(POOLING):  # joints without friction have zero variance and are ignored
        weight = np.divide(1.0, (variance + pooled) ** 2, out=np.zeros_like(variance), where=variance > 0)
        excess = np.sum(weight * (difference**2 - variance), axis=0)
        pooled = np.maximum(excess / np.maximum(weight.sum(axis=0), 1e-300), 0.0)
    likely = difference * pooled / np.maximum(pooled + variance, 1e-300)
    share, leakage, factors = np.zeros((len(solution.x),) * 2), np.zeros((len(solution.x),) * 2), []
    torque = np.array([power @ (AHEAD * pooled) for *_, power in found])
    for R, columns, change, (_, _, moved, leaked, _) in zip(
        solution.factors.R, solution.factors.columns, likely, found, strict=True
    ):
        share += (moved * (0.5 * AHEAD * pooled)) @ moved.T
        leakage += (leaked * (4.0 * pooled)) @ leaked.T
        steady = R.copy()
        steady[:, :, -1] -= 2.0 * _time(len(R))[:, None] * (R[:, :, :-1] @ (moved[columns] @ change))
        factors.append(steady)
    return share, leakage, torque, replace(solution, factors=replace(solution.factors, R=tuple(factors)))


def _time(blocks: int) -> np.ndarray:
    return (np.arange(blocks) + 0.5) / blocks - 0.5


def _drifts(design: Design, solution: LinearSolution, length: int, i: int) -> tuple[np.ndarray, ...]:
    """Return one joint's differences (2,) between the halves of the log and their variances, relative to friction.

    Also return the parameter changes (p, 2) for a unit change, the leakage of a zero-mean linear drift into the
    solution, and the mean square torque (2,) for a unit change.
    """
    factors, columns, x = solution.factors, solution.factors.columns[i], solution.x
    A, y = factors.R[i][:, :, :-1], factors.R[i][:, :, -1]
    blocks, rows = len(A), max(int(factors.rows[:, i].sum()), 1)
    D = _directions(design, x, i)
    size = np.sqrt(np.sum((A @ D) ** 2, axis=(0, 1)) / rows)
    scale = np.divide(size[0], size, out=np.zeros_like(size), where=size > 0)
    U, e, power = A @ (D * scale), y - A @ x[columns], max(rows * size[0] ** 2, 1e-300)
    change, variance = np.zeros((2, 2, len(DRIFTS)))
    for half, kept in enumerate(np.array_split(np.arange(blocks), 2)):
        gram = np.einsum("bij,bik->bjk", U[kept], U[kept])
        moment = np.einsum("bij,bi->bj", U[kept], e[kept])
        inverse = np.linalg.inv(gram.sum(axis=0) + RIDGE * power * np.eye(len(DRIFTS)))
        change[half] = inverse @ moment.sum(axis=0)
        left = moment - gram @ change[half]
        left = np.add.reduceat(left, np.arange(0, len(left), length), axis=0)
        freedom = len(left) / max(len(left) - len(DRIFTS), 1)
        variance[half] = np.sum((left @ inverse) ** 2, axis=0) * freedom
    moved, pushed = np.zeros((2, len(x), len(DRIFTS)))
    moved[columns] = D * scale
    pushed[columns] = solution.weights[i] ** 2 * np.einsum("b,bij,bik->jk", _time(blocks), A, U)
    leaked = solution.basis @ (solution.basis.T @ pushed)
    return change[1] - change[0], variance.sum(axis=0), moved, leaked, (scale * size) ** 2


def _directions(design: Design, x: np.ndarray, i: int) -> np.ndarray:
    """Return the changes (w, 2) of a joint's parameters for doubled friction, and for a unit offset."""
    columns, width = design.layout.columns[i], design.rigid[i].shape[1]
    D = np.zeros((len(columns), len(DRIFTS)))
    for k, term in enumerate(design.terms[i], width):
        if term == "offset":
            D[k, 1] = 1.0
        elif term in FRICTION_TERMS and FRICTION_TERMS[term].column is not None:
            D[k, 0] = x[columns[k]]
    return D


def _structure_share(design: Design, solution: LinearSolution) -> np.ndarray:
    x, M = solution.x, len(design.rows)
    cov, structure = np.zeros((len(x), len(x))), design.moved(x)
    trust = solution.row_weights.reshape(-1, M).T if solution.row_weights.size else np.ones_like(design.tau)
    block = np.arange(M) // max(1, round(BLOCK * design.data.rate / design.decimation.every))
    for i, full in enumerate(design.own_columns(structure)):
        columns, width, count = design.layout.columns[i], design.rigid[i].shape[1], len(design.terms[i])
        others = np.r_[:width, width + count : len(columns)]
        A = np.hstack([design.rigid[i], design.local[i]])
        y, root = design.tau[:, i] - A[:, others] @ x[columns[others]], np.sqrt(trust[:, i, None])
        here = int(np.flatnonzero((structure.terms[i] == TERMS).all(axis=1))[0])
        parameters, weights = _rivals(full * root, y * root[:, 0], block)
        if not weights[here]:
            continue
        own = np.linalg.pinv(mixing(TERMS[here], full.shape[1]))
        for rival in np.flatnonzero(weights):
            apart = parameters[rival] - parameters[here]
            pushed, moved = np.zeros((2, len(x)))
            pushed[columns] = solution.weights[i] ** 2 * (A * trust[:, i, None]).T @ (full @ apart)
            moved[columns[width : width + len(own)]] = own @ apart
            moved -= solution.basis @ (solution.basis.T @ pushed)
            cov += weights[rival] * np.outer(moved, moved)
    return cov


def _rivals(full: np.ndarray, y: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters (K, W) of a joint's columns (M, W) for each choice in TERMS, and their weights (K,)."""
    fold, count = block % FOLDS, block[-1] + 1
    parts = [(full[fold == f], y[fold == f]) for f in range(FOLDS)]
    grams, moments = (np.array(part) for part in zip(*((A.T @ A, A.T @ b) for A, b in parts)))
    gram, moment = grams.sum(axis=0), moments.sum(axis=0)
    parameters, errors = np.zeros((len(TERMS), full.shape[1])), np.full((len(TERMS), count), np.inf)
    for k, terms in enumerate(TERMS):
        T = mixing(terms, full.shape[1])
        solved = [_identified(T, gram - G, moment - m) for G, m in zip(grams, moments)]
        whole, alone = _identified(T, gram, moment), [_identified(T, G, m) for G, m in zip(grams, moments)]
        if whole is None or any(one is None for one in (*solved, *alone)):
            continue
        parameters[k] = whole
        left = np.einsum("mw,mw->m", full, np.array(solved)[fold])
        errors[k] = np.bincount(block, weights=(y - left) ** 2, minlength=count)
    total = errors.sum(axis=1)
    excess = np.where(np.isfinite(errors), errors - errors[np.argmin(total)], 0.0)
    deviation = np.std(excess, axis=1, ddof=1) * np.sqrt(count)
    t = np.divide(excess.sum(axis=1), deviation, out=np.zeros(len(TERMS)), where=deviation > 0)
    weights = np.where(np.isfinite(total), np.exp(-0.5 * t * t), 0.0)
    return parameters, weights / max(weights.sum(), 1e-300)


def _identified(T: np.ndarray, gram: np.ndarray, moment: np.ndarray) -> np.ndarray | None:
    """Return the parameters (W,) of the columns selected by T, or None if undetermined."""
    G = T.T @ gram @ T
    scale = np.sqrt(np.diag(G))
    if not scale.all():
        return None
    G = G / np.outer(scale, scale)
    if np.linalg.eigvalsh(G)[0] < IDENTIFIED:
        return None
    return T @ (np.linalg.solve(G, T.T @ moment / scale) / scale)
