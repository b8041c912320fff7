"""From residuals of one arm to a `Fit`: of equal fits the nearest, value, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.calibrate._kinematic_problem import KinematicProblem, State
from armlab.calibrate._kinematic_question import Question, check_misfit, never_moves, spread_of
from armlab.calibrate._kinematic_rank import Suspect
from armlab.calibrate._kinematic_words import far_links, may_be_missing, never_seen
from armlab.estimation import Fit, Measurement, NonlinearSolution
from armlab.models import KinematicCorrection


@dataclass(frozen=True, eq=False)
class ArmQuestion(Question[State]):
    """What is asked of the data of one arm."""

    problem: KinematicProblem

    def nature(self, state: State) -> list[Suspect]:
        """Return directions that these kinds of measurement may never see."""
        return never_seen(self.problem, state)

    def suspects(self, state: State) -> list[Suspect]:
        """Return directions that the data may fail to see."""
        return may_be_missing(self.problem, state)

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
        outside = np.flatnonzero(found.outliers)
        check_misfit(data, self.spaces(), found.value, outside)
        excitation = self.judge(data, state, sigma, outside)
        cov = self.covariance(data, state, sigma, outside, excitation)
        names = tuple(name for name, mine in zip(problem.names, self.used) if mine)
        return Fit(
            value=self._value(state, cov),
            names=names,
            units=tuple(unit for unit, mine in zip(problem.units, self.used) if mine),
            parameters=problem.values(state)[self.used],
            cov=cov,
            sigma=found.sigma,
            residuals=_table(data, problem),
            n=len(problem.arm.q),
            excitation=excitation,
            summary=lambda fit: "\n".join(
                [fit.table(), *notes, *self.match(found), *far_links(problem.arm, state.arm.frames)]
            ),
            outliers=found.outliers,
            classes=found.classes,
        )

    def _smallest(self, state: State) -> State:
        """Return the state, of those that no measurement tells from it, that is nearest to the start."""
        problem, foot, tool = self.problem, [], []
        if not any(kind.name == "pose" and len(kind.kept) == 6 for kind in problem.kinds):
            data = problem.measurements(state, local=True)
            unseen = never_moves(self.nature(state), data, self.used)
            foot, tool = unseen[:6], [False] * 3 + unseen[6:9] * (not problem.points)
        base, end = (np.eye(6)[:, np.flatnonzero(unseen)] for unseen in (foot, tool))
        frames, move = problem.arm.smallest(state.arm.frames, base, end)
        anchor = move[:3, :3] @ state.anchor + move[:3, 3]
        return state._replace(arm=state.arm._replace(frames=frames), anchor=anchor)

    def spaces(self) -> list[float]:
        """Return the size [m] of the space in which each measurement was made."""
        sizes = []
        for kind in self.problem.kinds:
            seen = kind.values[kind.visible]
            if kind.name == "position":
                sizes += [spread_of(seen)] * kind.values.shape[1]
            else:
                sizes.append(spread_of(seen[:, :3, 3]) if kind.name == "pose" else float(np.mean(seen)))
        return sizes

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


def _table(data: Sequence[Measurement], problem: KinematicProblem) -> np.ndarray:
    """Return residuals, a row per sample and then per pair, NaN where nothing was measured."""
    rows = problem.first_pair + max((len(kind.values) for kind in problem.kinds if kind.pairs is not None), default=0)
    table = np.full((rows, sum(one.r.shape[1] for one in data)), np.nan)
    first = 0
    for one in data:
        table[one.sample, first : first + one.r.shape[1]] = one.r
        first += one.r.shape[1]
    return table
