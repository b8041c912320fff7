"""The movement primitive of poses: a position and an orientation over one phase."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.errors import ShapeError
from armlab.lie import quaternion
from armlab.motion._pose_run import PoseRun
from armlab.motion._poses import apart, exp, matrix, orientation, pose, turn
from armlab.motion._saved import Saved
from armlab.motion._setting import Setting, vector
from armlab.motion.dmp import Dmp
from armlab.motion.pose_rollout import PoseRollout, PoseRunOptions
from armlab.motion.pose_stepper import PoseStepper

if TYPE_CHECKING:
    from armlab.motion.control import Controller, Limits
    from armlab.robots import Robot

__all__ = ["FRAMES", "PoseDmp"]

FRAMES = ("base", "goal")
SHARED = ("centres", "widths", "tau_d", "duration", "alpha_z", "beta_z", "alpha_x", "schedule", "convention")


@dataclass(frozen=True, eq=False)
class PoseDmp(Saved, kind="pose_dmp"):
    """A movement primitive of poses.

    The position is a `Dmp`. The orientation q follows, with angular velocity eta / tau_d in base axes ::

        tau_d eta' = alpha_z (beta_z log(g q^-1) - eta) + f(x),    tau_d q' = eta q / 2

    where log is the rotation vector on the shorter way and x the phase that both share. The forcing of the orientation
    is scaled by its rotation vector from start to goal, as that of the position by its displacement.

    Attributes
    ----------
    position : of three coordinates [m].
    rotation : of the rotation vector from the goal, base axes [rad]: its y0 leads from the goal to the start, g is 0.
    goal : (4,) orientation wxyz at the end of the demonstration.
    frame : axes that the forcing belongs to: "base", or "goal": it turns with the goal, so that start and goal moved
        together move the whole path.

    Raises
    ------
    ShapeError : parts that do not share their phase, or no quaternion as goal. UnknownName : another frame.

    References
    ----------
    Ude, Nemec, Petric and Morimoto, Orientation in Cartesian space dynamic movement primitives, ICRA 2014.
    """

    position: Dmp
    rotation: Dmp
    goal: np.ndarray
    frame: str = "base"

    UNITS: ClassVar[dict[str, str]] = {"goal": "1"}

    def __post_init__(self) -> None:
        """Check that the parts fit each other, and freeze."""
        check_name(self.frame, "frame of the forcing", FRAMES)
        for what, part in (("position", self.position), ("rotation", self.rotation)):
            if not isinstance(part, Dmp) or part.n != 3 or part.schedule == "position":
                raise ShapeError(
                    f"Expected the {what} as a Dmp of three coordinates with a phase of time, got another. "
                    "armlab.motion.fit_pose_dmp makes both."
                )
        for name in SHARED:
            if not np.array_equal(getattr(self.position, name), getattr(self.rotation, name)):
                raise ShapeError(f"Expected one {name} for position and rotation, got two. They share one phase.")
        if np.any(self.rotation.g != 0.0) or self.rotation.scaling not in ("goal", "none"):
            raise ShapeError(
                "Expected a rotation with goal 0 and scaling 'goal' or 'none', got another. It is measured from the "
                "goal."
            )
        goal = np.array(orientation(self.goal, "goal"))
        goal.flags.writeable = False
        object.__setattr__(self, "goal", goal)

    @property
    def duration(self) -> float:
        """Duration of the demonstration [s]."""
        return self.position.duration

    @cached_property
    def T_start(self) -> np.ndarray:
        """Pose (4, 4) at the start of the demonstration."""
        return matrix(self.position.y0, quaternion.multiply(exp(self.rotation.y0), self.goal))

    @cached_property
    def T_goal(self) -> np.ndarray:
        """Pose (4, 4) at the end of the demonstration."""
        return matrix(self.position.g, self.goal)

    def run_of(
        self,
        duration: float | None = None,
        tau_d: float | None = None,
        start: ArrayLike | None = None,
        twist0: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> PoseRun:
        """Resolve what the caller has left out by the demonstration.

        Parameters
        ----------
        duration, tau_d, start, twist0, goal : `PoseRunOptions`.
        """
        p0, q0 = pose(self.T_start if start is None else start, "start")
        p1, q1 = pose(self.T_goal if goal is None else goal, "goal")
        A = turn(self.goal, q1) if self.frame == "goal" else np.eye(3)
        v0 = w0 = None
        if twist0 is not None:
            v0, w0 = vector(twist0, "twist0", 6).reshape(2, 3) @ A
        position = Setting.of(self.position, duration=duration, tau_d=tau_d, y0=p0 @ A, v0=v0, g=p1 @ A)
        rotation = Setting.of(self.rotation, tau_d=position.tau, y0=-apart(q0, q1) @ A, v0=w0, g=np.zeros(3))
        return PoseRun(A, position, rotation, q0, q1)

    def rollout(self, t: ArrayLike, **run: Unpack[PoseRunOptions]) -> PoseRollout:
        """Run the primitive with one step per interval, both parts to fourth order.

        What is left out is that of the demonstration.

        Parameters
        ----------
        t : (N,) increasing times [s], the motion starts at the first; or one step [s] until the end of the motion.
        **run : `PoseRunOptions`: ``duration`` or ``tau_d`` of the run [s]; ``start``, ``goal``: poses (4, 4), or (7,):
            position, quaternion wxyz of either sign; ``twist0`` (6,): velocity and angular velocity at the start, base
            axes.

        Raises
        ------
        ShapeError : times that do not increase, no poses, NaN, start and goal half a turn apart.
        ConfigError : both duration and tau_d.
        """
        setting = self.run_of(**run)
        at, A = setting.position, setting.A
        times = at.times(t)
        y, yd, ydd, x, _ = at.primitive.rollout(times, at.tau, at.y0, at.v0, at.g, at.scale)
        q, w, wd = kernels.rotation_rollout(self.rotation.primitive, times, *setting.turning)
        twist, twistd = (np.concatenate([v @ A.T, turning], axis=1) for v, turning in ((yd, w), (ydd, wd)))
        return PoseRollout(np.array(times), matrix(y @ A.T, q), q, twist, twistd, x)

    def stepper(self, **run: Unpack[PoseRunOptions]) -> PoseStepper:
        """Return what runs the primitive sample by sample, with a goal that may change on the way.

        Parameters
        ----------
        **run : as in `rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`.
        """
        return PoseStepper(self, self.run_of(**run))

    def controller(
        self,
        robot: Robot,
        *,
        limits: Limits | None = None,
        duration: float | None = None,
        goal: ArrayLike | None = None,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge`, which leads the tool from where it is, at rest.

        Parameters
        ----------
        robot : the arm; its joints come by inverse kinematics, each from the one before.
        limits : what has q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`; those of the robot when None.
        duration, goal : as in `rollout`; poses are those of the tool, base axes.

        Raises
        ------
        ShapeError : a goal that the arm does not reach. ConfigError : as in `rollout`.
        """
        from armlab.motion.pose_controller import PoseDmpController

        return PoseDmpController(robot, self, {"duration": duration, "goal": goal}, limits)
