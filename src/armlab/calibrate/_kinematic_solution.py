"""From residuals of one arm to a `Fit`: descent, what the data tell, covariance without the gauge."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.calibrate._kinematic_problem import KinematicProblem, State
from armlab.calibrate._kinematic_rank import Judgement, Suspect, spread_covariance
from armlab.calibrate._kinematic_words import may_be_missing, never_seen
from armlab.errors import NotConverged, NotExcited
from armlab.estimation import Excitation, Fit, Measurement, NonlinearSolution, Problem, nonlinear_least_squares
from armlab.models import KinematicCorrection

SCHEDULE = (1000.0, 300.0, 100.0, 30.0, 10.0)
UNIT = 1e-3  # 1 mm and 1 mrad: of equal steps the smallest is taken
NOBODY = np.zeros(0, dtype=int)
MISFIT = 0.1  # of the size of what was measured: these samples do not belong together


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of the data.

    Attributes
    ----------
    problem : residuals. used : (d,) unknowns there are, gauge included. limits : (metres, radians) that are accepted.
    hold : go on where they are exceeded.
    """

    problem: KinematicProblem
    used: np.ndarray
    limits: tuple[float, float]
    hold: bool

    def solve(self, start: State, robust: bool) -> NonlinearSolution[State]:
        """Descend; where that fails say which direction the data do not tell, if there is one.

        Raises
        ------
        NotConverged, NotExcited : see `fit_kinematics`.
        """
        problem = self.problem
        self._check_count(start)
        task = Problem(problem.evaluate, problem.retract, problem.sizes(UNIT, UNIT)[problem.active], "arm")
        try:
            return nonlinear_least_squares(task, start, robust=robust, schedule=SCHEDULE)
        except NotConverged:
            self._judge(problem.measurements(start, local=True), start, dict.fromkeys(_classes(problem), UNIT))
            raise

    def fit(self, found: NonlinearSolution[State], smallest: bool, notes: Sequence[str]) -> Fit[KinematicCorrection]:
        """Return value, covariance and what the data tell; of equal fits the one nearest to the start.

        Raises
        ------
        NotExcited, NotConverged : see `fit_kinematics`.
        """
        problem, state = self.problem, found.value
        if smallest:
            state = self._smallest(state)
        sigma = dict(zip(found.classes, found.sigma.tolist()))
        data = problem.measurements(state, local=True)
        residuals = _table(data, problem)
        self._check_fit(found, residuals)
        outside = np.flatnonzero(found.outliers)
        excitation = self._judge(data, state, sigma, outside)
        cov = self._covariance(data, state, sigma, outside, excitation)
        names = tuple(name for name, mine in zip(problem.names, self.used) if mine)
        return Fit(
            value=self._value(state, cov),
            names=names,
            units=tuple(unit for unit, mine in zip(problem.units, self.used) if mine),
            parameters=problem.values(state)[self.used],
            cov=cov,
            sigma=found.sigma,
            residuals=residuals,
            n=len(problem.arm.q),
            excitation=excitation,
            summary=lambda fit: "\n".join([fit.table(), *notes]),
            outliers=found.outliers,
            classes=found.classes,
        )

    def _smallest(self, state: State) -> State:
        """Return the state, of those that no measurement tells from it, that is nearest to the start."""
        problem, foot, tool = self.problem, [], []
        if not any(kind.name == "pose" and len(kind.kept) == 6 for kind in problem.kinds):
            unseen = [_counts(suspect, problem, state, self.used) for suspect in never_seen(problem, state)]
            foot, tool = unseen[:6], [False] * 3 + unseen[6:9] * (not problem.points)
        base, end = (np.eye(6)[:, np.flatnonzero(unseen)] for unseen in (foot, tool))
        frames, move = problem.arm.smallest(state.arm.frames, base, end)
        anchor = move[:3, :3] @ state.anchor + move[:3, 3]
        return state._replace(arm=state.arm._replace(frames=frames), anchor=anchor)

    def _check_count(self, start: State) -> None:
        """Refuse fewer numbers than unknowns."""
        problem, used = self.problem, self.used
        got, each = sum(kind.numbers for kind in problem.kinds), sum(len(kind.kept) for kind in problem.kinds)
        if self.hold or got > np.count_nonzero(used):
            return
        G, _ = problem.gauge(start, used)
        needed = int(np.count_nonzero(used)) - int(np.linalg.matrix_rank(G[used]))
        needed -= sum(_counts(suspect, problem, start, used) for suspect in never_seen(problem, start))
        needed -= 2 * problem.arm.n * len(problem.arm.orders)  # their prior is enough
        needed += any(kind.cov is None for kind in problem.kinds)
        if got < needed:
            raise NotExcited(
                f"Expected at least {needed} numbers for the unknowns of the arm, got {got}. Measure at least "
                f"{-(-needed // each)} samples, better twice as many.",
                ["everything"],
                [f"{got} of {needed} numbers"],
            )

    def _judge(
        self, data: Sequence[Measurement], state: State, sigma: dict[str, float], outside: np.ndarray = NOBODY
    ) -> Excitation:
        """Return what the data tell at a state, or refuse."""
        problem, used = self.problem, self.used
        G, gauge_names = problem.gauge(state, used)
        judgement = Judgement(
            names=[name for name, mine in zip(problem.names, used) if mine],
            units=[unit for unit, mine in zip(problem.units, used) if mine],
            limits=problem.sizes(*self.limits)[used],
            gauge=G[used],
            gauge_names=gauge_names,
            nature=_inside(never_seen(problem, state), used),
            suspects=_inside(may_be_missing(problem, state), used),
            what="arm",
        )
        return judgement.excitation(np.concatenate(list(_whitened(data, sigma, outside)))[:, used], self.hold)

    def _covariance(
        self,
        data: Sequence[Measurement],
        state: State,
        sigma: dict[str, float],
        outside: np.ndarray,
        excitation: Excitation,
    ) -> np.ndarray:
        """Return the covariance (p, p) of what is used, zero along gauge and along what nothing tells."""
        priors, limits = list(self.problem.priors(state, local=True)), self.problem.sizes(*self.limits)[self.used]
        if not priors:
            return spread_covariance(excitation.vectors, excitation.spread, limits)
        rows = np.concatenate(list(_whitened([*data, *priors], sigma, outside)))[:, self.used] * limits
        G = self.problem.gauge(state, self.used)[0][self.used] / limits[:, None]
        whole = np.eye(len(limits)) if not G.shape[1] else np.linalg.svd(G, full_matrices=True)[0][:, G.shape[1] :]
        _, singular, V = np.linalg.svd(np.linalg.qr(rows @ whole, mode="r"))
        seen = singular > 1e-9 * singular[0]
        return spread_covariance(whole @ V[seen].T, 1.0 / singular[seen], limits)

    def _check_fit(self, found: NonlinearSolution[State], residuals: np.ndarray) -> None:
        """Refuse samples that do not belong together."""
        kept = residuals[: len(found.outliers)][~found.outliers]
        for kind in self.problem.kinds:
            if kind.name == "pose":
                size, columns = _spread(kind.values[kind.visible][:, :3, 3]), range(np.count_nonzero(kind.kept < 3))
            elif kind.name == "position":
                size, columns = _spread(kind.values[kind.visible]), range(kept.shape[1])
            else:
                size, columns = float(np.mean(kind.values[kind.visible])), range(kept.shape[1])
            off = kept[:, list(columns)]
            rms = float(np.sqrt(np.nanmean(off**2))) if len(self.problem.kinds) == 1 and off.size else 0.0
            if rms > MISFIT * size and len(kept) > 3:
                raise NotConverged(
                    f"Expected an arm that fits the measurements, got residuals of {rms:.3g} m in a space of "
                    f"{size:.3g} m. Check units, the order of the joints, and whether samples and joint positions "
                    "belong together.",
                    best=found.value,
                    history=found.history,
                )

    def _value(self, state: State, cov: np.ndarray) -> KinematicCorrection:
        arm, problem = self.problem.arm, self.problem
        whole = np.zeros((problem.size, problem.size))
        whole[np.ix_(self.used, self.used)] = cov
        anchored = bool(self.used[arm.size + 3 * problem.points : -2].any())
        return KinematicCorrection(
            robot=arm.corrected(state.arm.frames),
            robot_name=arm.robot.name,
            robot_hash=arm.robot.hash,
            harmonics=arm.orders,
            amplitudes=state.arm.amplitudes,
            coefficients=state.arm.coefficients,
            cov=whole[: arm.size, : arm.size],
            points=state.points,
            anchor=state.anchor if anchored else None,
            length_offset=float(state.length[0]),
            length_scale=float(state.length[1]),
        )


def _classes(problem: KinematicProblem) -> list[str]:
    return [name for kind in problem.kinds for name in kind.classes]


def _inside(suspects: Sequence[Suspect], used: np.ndarray) -> list[Suspect]:
    """Return directions that move something that is used, cut to it."""
    found = [Suspect(one.name, one.directions[used], one.advice) for one in suspects]
    return [one for one in found if np.abs(one.directions).max(initial=0.0) > 0]


def _counts(suspect: Suspect, problem: KinematicProblem, state: State, used: np.ndarray) -> bool:
    """Tell whether a direction of the used unknowns is one that these kinds never see."""
    v = suspect.directions[:, 0] * used
    if not v.any():
        return False
    return all(np.abs(one.J @ v).max(initial=0.0) < 1e-9 for one in problem.measurements(state, local=True))


def _whitened(data: Sequence[Measurement], sigma: dict[str, float], outside: np.ndarray) -> Iterator[np.ndarray]:
    """Yield whitened derivatives (m, d) of the samples that are kept."""
    for one in data:
        kept = np.ones(len(one.r), dtype=bool) if one.prior else ~np.isin(one.sample, outside)
        roots, J = one.roots(sigma), one.J[kept]
        white = roots[:, None] * J if roots.ndim == 1 else (roots if roots.ndim == 2 else roots[kept]) @ J
        yield white.reshape(-1, one.J.shape[2])


def _table(data: Sequence[Measurement], problem: KinematicProblem) -> np.ndarray:
    """Return residuals, a row per sample and then per pair, NaN where nothing was measured."""
    rows = problem.first_pair + max((len(kind.values) for kind in problem.kinds if kind.pairs is not None), default=0)
    table = np.full((rows, sum(one.r.shape[1] for one in data)), np.nan)
    first = 0
    for one in data:
        table[one.sample, first : first + one.r.shape[1]] = one.r
        first += one.r.shape[1]
    return table


def _spread(points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
