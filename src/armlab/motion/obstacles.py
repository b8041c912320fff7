"""Obstacle avoidance for movement primitives; obstacles are points, spheres or capsules."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._display import Shown
from armlab._numbers import check_name, make_read_only, members, number, numbers
from armlab.errors import ConfigError, ShapeError
from armlab.estimation.fit import value_of
from armlab.motion.arguments import vector
from armlab.motion.control import JointLimits
from armlab.motion.dmp import Dmp, DmpController
from armlab.motion.primitive.run import Rollout, RunOptions, RunParameters, Stepper
from armlab.robots import Robot

if TYPE_CHECKING:
    from armlab.log import Column

FORMS = ("steering", "potential")


@dataclass(frozen=True, eq=False, repr=False)
class Capsule(Shown):
    """Set of all points within `radius` of the segment from a to b; a sphere or a point if a = b.

    Attributes
    ----------
    a, b : (d,) end points, in the plane or in space [m].
    radius : radius [m].
    velocity : (d,) velocity of a moving obstacle [m/s].

    Raises
    ------
    ShapeError : wrong shapes, non-finite values, or a negative radius.
    """

    a: np.ndarray
    b: np.ndarray
    radius: float = 0.0
    velocity: ArrayLike = 0.0

    def __post_init__(self) -> None:
        for name in ("a", "b", "velocity"):
            point = np.array(numbers(getattr(self, name), name, ShapeError))
            if name == "velocity" and not point.ndim:
                point = np.full(len(self.a), float(point))
            if point.ndim != 1 or len(point) not in (2, 3) or not np.isfinite(point).all():
                raise ShapeError(f"Expected {name} to be a finite point (2,) or (3,), got shape {point.shape}.")
            object.__setattr__(self, name, point)
        radius = number(self.radius, "radius [m]")
        if not self.a.shape == self.b.shape == np.shape(self.velocity) or not 0.0 <= radius < np.inf:
            raise ShapeError(
                f"Expected a, b and velocity of equal shape and a radius >= 0 m, got shapes {self.a.shape}, "
                f"{self.b.shape}, {np.shape(self.velocity)} and radius {radius:g} m. Correct them."
            )
        make_read_only(self, "a", "b", "velocity")

    @classmethod
    def sphere(cls, centre: ArrayLike, radius: float = 0.0, velocity: ArrayLike = 0.0) -> Capsule:
        """Return a sphere, or a point if the radius is 0.

        Parameters
        ----------
        centre : (d,) centre [m].
        radius : radius [m].
        velocity : (d,) velocity [m/s].
        """
        c = numbers(centre, "centre", ShapeError)
        return cls(c, c, radius, velocity)


@dataclass(frozen=True, eq=False, repr=False)
class AvoidingDmp(Shown):
    """Movement primitive that avoids obstacles and keeps a clearance from them.

    Within `reach`, each obstacle adds an acceleration that steers the velocity away or follows the gradient of a
    potential. A safeguard keeps the distance above the clearance. docs/theory/obstacles.md describes the laws and their
    guarantees.

    Attributes
    ----------
    dmp : primitive, or the result of `fit_dmp`, with a time-based phase. The coordinates of the primitive are two or
        three positions [m], or the joints of `robot`.
    obstacles : obstacles in the coordinates of the motion, or in base axes for a robot.
    clearance : smallest allowed distance from the obstacle surfaces [m].
    reach : distance within which obstacles act [m].
    form : avoidance law, "steering" or "potential".
    robot : the arm.
    tool : capsule of the tool, in tool axes; default: the tool point.
    links : capsules around the links, keyed by link number from 1, in the axes of `kinematics.link_transforms`.

    Raises
    ------
    ShapeError : obstacles of the wrong dimension.
    UnknownName : unknown form.
    ConfigError : a primitive with the wrong coordinates or schedule "position", or reach <= clearance.

    References
    ----------
    Park, Hoffmann, Pastor and Schaal, Humanoids 2008; Hoffmann, Pastor, Park and Schaal, ICRA 2009; Maciejewski and
    Klein, Int. J. Robotics Research 4(3), 1985; Nguyen and Sreenath, ACC 2016.
    """

    dmp: Dmp
    obstacles: Sequence[Capsule]
    clearance: float
    reach: float
    form: str = "steering"
    robot: Robot | None = None
    tool: Capsule | None = None
    links: Mapping[int, Capsule] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "dmp", value_of(self.dmp))
        check_name(self.form, "form of avoidance", FORMS)
        wanted = (2, 3) if self.robot is None else (self.robot.n,)
        if self.dmp.schedule == "position" or self.dmp.n not in wanted:
            raise ConfigError(
                f"Expected a primitive of {' or '.join(map(str, wanted))} coordinates with a time-dependent phase, "
                f"got {self.dmp.n} coordinates with schedule {self.dmp.schedule!r}. Pass the robot if these "
                "coordinates are joint positions."
            )
        if self.robot is None and (self.tool is not None or self.links):
            raise ConfigError("Expected a robot for the capsules of the tool and links, got no robot. Pass robot=...")
        for name in ("clearance", "reach"):
            object.__setattr__(self, name, number(getattr(self, name), f"{name} [m]", ConfigError))
        if not 0.0 <= self.clearance < self.reach < np.inf:
            raise ConfigError(
                f"Expected 0 <= clearance < reach, got {self.clearance} and {self.reach} m. Correct them."
            )
        object.__setattr__(self, "obstacles", members(self.obstacles, "obstacles"))
        self._around()

    def _around(self) -> Any:
        """Return the obstacles as `armlab.kernels.Obstacles`."""
        parts = (self.dmp.n, None, None)
        if self.robot is not None:
            parts = (self.robot.chain, *_bodies(self.robot, self.tool, self.links))
        around = kernels.Obstacles(*parts, self.clearance, self.reach, self.form == "potential")
        around.place(rows_of(self.obstacles, self._axes))
        return around

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.dmp.n

    @property
    def _axes(self) -> int:
        """Dimension of the space, 2 or 3."""
        return self.dmp.n if self.robot is None else 3

    def distance(self, y: ArrayLike) -> np.ndarray:
        """Return the smallest distance (...) to the surface of any obstacle [m]; infinite without obstacles.

        Parameters
        ----------
        y : (..., n) coordinates.
        """
        return self._around().distance(vector(y, "y", self.dmp.n))

    def rollout(self, t: ArrayLike, **run: Unpack[RunOptions]) -> Rollout:
        """Return the motion at times t.

        Parameters
        ----------
        t : as in `Dmp.rollout`.
        **run : `RunOptions`.

        Raises
        ------
        ShapeError : start or goal within the clearance, or as in `Dmp.rollout`.
        """
        setting, around = self._resolved(run)
        times = setting.times(t)
        kernel = kernels.PrimitiveStepper(setting.primitive, 0.0, around)
        kernel.start(setting.y0, setting.v0, setting.g, setting.scale, setting.tau)
        y, yd, ydd, f = kernel.follow(times)
        return Rollout(times, y, yd, ydd, self.dmp.phase(times - times[0], setting.tau), f)

    def stepper(self, **run: Unpack[RunOptions]) -> AvoidingStepper:
        """Return a stepper that runs the primitive sample by sample among moving obstacles.

        In addition to the members of `Stepper`, ``place(obstacles)`` sets the current obstacles; they keep moving at
        their velocity until the next call. `distance` is the smallest distance to their surfaces [m].

        Parameters
        ----------
        **run : `RunOptions`.

        Raises
        ------
        ShapeError : start or goal within the clearance, or as in `Dmp.stepper`.
        """
        return AvoidingStepper(self, *self._resolved(run))

    def controller(
        self, limits: JointLimits | Sequence[JointLimits] | None = None, *, duration: float | None = None,
        g: ArrayLike | None = None,
    ) -> AvoidingController:  # fmt: skip
        """Return a controller for the robot that starts at rest at the measured position.

        In addition to the members of `Controller`, ``place(obstacles)`` sets the current obstacles, before or during
        the run.

        Parameters
        ----------
        limits : as in `Dmp.controller`.
        duration, g : as in `Dmp.rollout`.

        Raises
        ------
        ConfigError : no robot.
        ShapeError : the causes listed for `stepper` and `Dmp.controller`.
        """
        return AvoidingController(self, {"duration": duration, "g": g}, limits)

    def _resolved(self, given: RunOptions) -> tuple[RunParameters, Any]:
        run, around = RunParameters.of(self.dmp, **given), self._around()
        self._check_clear("start", run.y0, around)
        self._check_clear("goal", run.g, around)
        return run, around

    def _check_clear(self, name: str, y: np.ndarray, around: Any) -> None:
        """Raise an error if the start or the goal is within the clearance of the current obstacles."""
        if not (least := float(around.distance(y))) > self.clearance:
            raise ShapeError(
                f"Expected the {name} to be outside the clearance of "
                f"every obstacle, got a distance of {least:.4g} m. Move "
                f"the {name}, or reduce the clearance of {self.clearance:g} m."
            )


def rows_of(capsules: Iterable[Capsule], axes: int) -> np.ndarray:
    """Return kernel rows (K, 10): ends, radius and velocity of K capsules in 2 or 3 dimensions."""
    rows = []
    for i, one in enumerate(members(capsules, "capsules")):
        if not isinstance(one, Capsule):
            raise ShapeError(f"Expected capsules, got {one!r:.50} at index {i}. Use motion.Capsule.")
        if len(one.a) != axes:
            raise ShapeError(f"Expected capsules in {axes} dimensions, got {len(one.a)} dimensions at index {i}.")
        a, b, velocity = (np.append(x, np.zeros(3 - axes)) for x in (one.a, one.b, np.asarray(one.velocity)))
        rows.append(np.concatenate([a, b, [one.radius], velocity]))
    return np.array(rows).reshape(-1, 10)


def _bodies(robot: Robot, tool: Capsule | None, links: Mapping[int, Capsule]) -> tuple[np.ndarray, np.ndarray]:
    """Return link numbers (B,) and capsules (B, 7) in link axes; the tool capsule belongs to the last link."""
    T_link_tool = robot.chain.frames[-1]
    held = rows_of([tool or Capsule.sphere(np.zeros(3))], 3)[:, :7]
    for end in (slice(0, 3), slice(3, 6)):
        held[:, end] = held[:, end] @ T_link_tool[:3, :3].T + T_link_tool[:3, 3]
    wrong = [k for k in links if k not in range(1, robot.n + 1)]
    if wrong:
        raise ConfigError(f"Expected link numbers from 1 to {robot.n}, got {wrong[0]!r}. Use `tool` for the tool.")
    return np.array([robot.n, *links], dtype=float), np.concatenate([held, rows_of(links.values(), 3)[:, :7]])


class AvoidingStepper(Stepper):
    """Sample-by-sample run of an `AvoidingDmp`; created by `AvoidingDmp.stepper`."""

    def __init__(self, avoiding: AvoidingDmp, run: RunParameters, around: Any) -> None:
        self._around, self._avoiding = around, avoiding
        super().__init__(run, around=around)

    def reset(self) -> None:
        """Return to the start and restore the initial goal, duration and obstacles."""
        self.place(self._avoiding.obstacles)
        super().reset()

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Set the current obstacles; they keep moving at their velocity until the next call."""
        self._around.place(rows_of(obstacles, self._avoiding._axes))

    def change_goal(self, g: ArrayLike) -> None:
        """Change the goal."""
        self._avoiding._check_clear("goal", vector(g, "g", self._avoiding.n), self._around)
        super().change_goal(g)

    @property
    def distance(self) -> float:
        """Current smallest distance to the surface of any obstacle [m]."""
        return float(self._around.distance(self.state[0]))


class AvoidingController(DmpController):
    """Controller of a joint-space `AvoidingDmp` that ends the run if the arm starts within the clearance."""

    _dmp: AvoidingDmp
    _stepper: AvoidingStepper

    def __init__(
        self, avoiding: AvoidingDmp, settings: RunOptions, limits: JointLimits | Sequence[JointLimits] | None = None
    ) -> None:
        if avoiding.robot is None:
            raise ConfigError("Expected an AvoidingDmp in joint space, got a Cartesian AvoidingDmp. Pass robot=...")
        super().__init__(avoiding.robot, avoiding, settings, limits)

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Set the current obstacles, before or during the run; see `AvoidingStepper.place`."""
        self._dmp = replace(self._dmp, obstacles=tuple(obstacles))
        self._stepper.place(self._dmp.obstacles)

    def columns(self) -> dict[str, Column]:
        """Return the recorded columns, for ``link.run(extra=...)``."""
        from armlab.log import Column

        return super().columns() | {"distance": Column((), unit="m")}

    def _record(self) -> dict[str, Any]:
        return {"distance": np.float64(self._stepper.distance)}
