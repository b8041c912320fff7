"""From residuals of two arms to a `Fit`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.calibrate._arm import Arm, ArmState
from armlab.calibrate._dual_problem import DualProblem, DualState
from armlab.calibrate._kinematic_question import Question, check_misfit, spread_of
from armlab.calibrate._kinematic_rank import Suspect
from armlab.calibrate._kinematic_words import far_links
from armlab.estimation import Fit, NonlinearSolution
from armlab.lie import se3
from armlab.models import DualArmCorrection, KinematicCorrection


@dataclass(frozen=True, eq=False)
class DualQuestion(Question[DualState]):
    """What is asked of the data of two arms."""

    problem: DualProblem

    def nature(self, state: DualState) -> list[Suspect]:
        """Return directions that these kinds of measurement may never see."""
        return self.problem.never_seen()

    def suspects(self, state: DualState) -> list[Suspect]:
        """Return directions that the data may fail to see."""
        return self.problem.may_be_missing(state)

    def fit(self, found: NonlinearSolution[DualState]) -> Fit[DualArmCorrection]:
        """Return value, covariance and what the data tell."""
        problem, state = self.problem, found.value
        tool = np.eye(6)[:, 3:] if problem.kinds[0].name == "position" else np.zeros((6, 0))
        a, _ = problem.arm_a.smallest(state.a.frames, np.zeros((6, 0)), np.zeros((6, 0)))
        b, _ = problem.arm_b.smallest(state.b.frames, np.zeros((6, 0)), tool)
        state = DualState(state.a._replace(frames=a), state.b._replace(frames=b), se3.project(state.T)[0])
        sigma, outside = dict(zip(found.classes, found.sigma.tolist())), np.flatnonzero(found.outliers)
        data = problem.measurements(state)
        check_misfit(data, self.spaces(), found.value, np.flatnonzero(found.outliers))
        excitation = self.judge(data, state, sigma, outside)
        cov = self.covariance(data, state, sigma, outside, excitation)
        residuals = np.full((len(problem.arm_a.q), sum(one.r.shape[1] for one in data)), np.nan)
        for i, one in enumerate(data):
            first = data[0].r.shape[1] * i
            residuals[one.sample, first : first + one.r.shape[1]] = one.r
        return Fit(
            value=self._value(state, cov),
            names=tuple(name for name, mine in zip(problem.names, self.used) if mine),
            units=tuple(unit for unit, mine in zip(problem.units, self.used) if mine),
            parameters=problem.values(state)[self.used],
            cov=cov,
            sigma=found.sigma,
            residuals=residuals,
            n=len(residuals),
            excitation=excitation,
            summary=lambda fit: "\n".join([fit.table(), *self.match(found), *self._far(state)]),
            outliers=found.outliers,
            classes=found.classes,
        )

    def spaces(self) -> list[float]:
        """Return the size [m] of the space in which each measurement was made; of a closed chain, in which a moved."""
        problem = self.problem
        places = [kind.values[kind.visible.reshape(len(kind.values), -1)[:, 0]] for kind in problem.kinds]
        if problem.closed:
            places[0] = problem.arm_a.move(problem.arm_a.first()).T
        return [spread_of(seen[:, 0] if seen.shape[1:] == (1, 3) else seen[:, :3, 3]) for seen in places]

    def _far(self, state: DualState) -> list[str]:
        a, b = self.problem.arm_a, self.problem.arm_b
        return far_links(a, state.a.frames, " of arm a") + far_links(b, state.b.frames, " of arm b")

    def _value(self, state: DualState, cov: np.ndarray) -> DualArmCorrection:
        problem, a = self.problem, self.problem.arm_a.size
        whole = np.zeros((problem.size, problem.size))
        whole[np.ix_(self.used, self.used)] = cov
        arm_a = _correction(problem.arm_a, state.a, whole[:a, :a])
        return DualArmCorrection(arm_a, _correction(problem.arm_b, state.b, whole[a:-6, a:-6]), state.T, whole)


def _correction(arm: Arm, state: ArmState, cov: np.ndarray) -> KinematicCorrection:
    return KinematicCorrection(
        robot=arm.corrected(state.frames),
        robot_name=arm.robot.name,
        robot_hash=arm.robot.hash,
        harmonics=arm.orders,
        amplitudes=state.amplitudes,
        coefficients=state.coefficients,
        cov=cov,
    )
