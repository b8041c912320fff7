"""Obstacles on the way of a movement primitive: points, spheres and capsules that it goes around."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name, make_read_only, members, number, numbers
from armlab.errors import ConfigError, ShapeError
from armlab.motion.arguments import vector
from armlab.motion.control import JointLimits
from armlab.motion.dmp import Dmp, DmpController
from armlab.motion.primitive.run import Rollout, RunOptions, RunParameters, Stepper
from armlab.robots import Robot

if TYPE_CHECKING:
    from armlab.log import Column

FORMS = ("steering", "potential")


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` of the segment from a to b; a sphere where these are one, or a point.

    Attributes
    ----------
    a, b : (d,) ends, in the plane or in space [m]. radius : [m]. velocity : (d,) of an obstacle that moves [m/s].

    Raises
    ------
    ShapeError : points of other shapes, not finite, a negative radius.
    """

    a: np.ndarray
    b: np.ndarray
    radius: float = 0.0
    velocity: ArrayLike = 0.0

    def __post_init__(self) -> None:
        """Check and freeze."""
        for name in ("a", "b", "velocity"):
            point = np.array(numbers(getattr(self, name), name, ShapeError))
            if name == "velocity" and not point.ndim:
                point = np.full(len(self.a), float(point))
            if point.ndim != 1 or len(point) not in (2, 3) or not np.isfinite(point).all():
                raise ShapeError(f"Expected {name} as a finite point (2,) or (3,), got shape {point.shape}.")
            object.__setattr__(self, name, point)
        radius = number(self.radius, "radius [m]")
        if not self.a.shape == self.b.shape == np.shape(self.velocity) or not 0.0 <= radius < np.inf:
            raise ShapeError("Expected both ends in one space and a radius of 0 or more, got others. Correct it.")
        make_read_only(self, "a", "b", "velocity")

    @classmethod
    def sphere(cls, centre: ArrayLike, radius: float = 0.0, velocity: ArrayLike = 0.0) -> Capsule:
        """Return a sphere, or a point without a radius.

        Parameters
        ----------
        centre : (d,) [m]. radius : [m]. velocity : (d,) [m/s].
        """
        c = numbers(centre, "centre", ShapeError)
        return cls(c, c, radius, velocity)


@dataclass(frozen=True, eq=False)
class AvoidingDmp:
    """A movement primitive that goes around obstacles and keeps a clearance from them.

    Within `reach` the acceleration of an obstacle is added, steering the velocity away from it or as the slope of a
    potential; a guard keeps the distance above the clearance. The laws, and what is guaranteed and what is not:
    docs/theory/obstacles.md.

    Attributes
    ----------
    dmp : of two or three coordinates [m], or of the joints of `robot`, with a phase of time.
    obstacles : any number, in the coordinates of the motion, or in base axes.
    clearance : least distance from their surfaces [m]. reach : distance at which they act [m].
    form : "steering" or "potential".
    robot : the arm. tool : what it carries, in tool axes; the tool point when left out.
    links : by number from 1, the capsules around them in the axes of `kinematics.link_transforms`.

    Raises
    ------
    ShapeError : obstacles of another space. UnknownName : another form.
    ConfigError : a primitive of other coordinates or with schedule "position", a reach not above the clearance.

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
        """Check everything once."""
        check_name(self.form, "form of avoidance", FORMS)
        wanted = (2, 3) if self.robot is None else (self.robot.n,)
        if self.dmp.schedule == "position" or self.dmp.n not in wanted:
            raise ConfigError(
                f"Expected a primitive of {' or '.join(map(str, wanted))} coordinates with a phase of time, got "
                f"{self.dmp.n} with schedule {self.dmp.schedule!r}. Give the robot if these are its joints."
            )
        if self.robot is None and (self.tool is not None or self.links):
            raise ConfigError("Expected tool and links only with a robot, got them without one. Give robot=.")
        for name in ("clearance", "reach"):
            object.__setattr__(self, name, number(getattr(self, name), f"{name} [m]", ConfigError))
        if not 0.0 <= self.clearance < self.reach < np.inf:
            raise ConfigError(
                f"Expected 0 <= clearance < reach, got {self.clearance} and {self.reach} m. Correct them."
            )
        object.__setattr__(self, "obstacles", members(self.obstacles, "obstacles"))
        self._around()

    def _around(self) -> Any:
        """Return the `armlab.kernels.Obstacles` of it."""
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
        """Axes of the space, 2 or 3."""
        return self.dmp.n if self.robot is None else 3

    def distance(self, y: ArrayLike) -> np.ndarray:
        """Return the least distance (...) from the surface of any obstacle [m]; infinite where there is none.

        Parameters
        ----------
        y : (..., n).
        """
        return self._around().distance(vector(y, "y", self.dmp.n))

    def rollout(self, t: ArrayLike, **run: Unpack[RunOptions]) -> Rollout:
        """Return the motion at times t.

        Parameters
        ----------
        t : as of `Dmp.rollout`. **run : `RunOptions`.

        Raises
        ------
        ShapeError : start or goal within the clearance, and as of `Dmp.rollout`.
        """
        setting, around = self._resolved(run)
        times = setting.times(t)
        kernel = kernels.PrimitiveStepper(setting.primitive, 0.0, around)
        kernel.start(setting.y0, setting.v0, setting.g, setting.scale, setting.tau)
        y, yd, ydd, f = kernel.follow(times)
        return Rollout(times, y, yd, ydd, self.dmp.phase(times - times[0], setting.tau), f)

    def stepper(self, **run: Unpack[RunOptions]) -> AvoidingStepper:
        """Return what runs it sample by sample, among obstacles that may move.

        Besides what `Stepper` has, ``place(obstacles)`` says where all obstacles are now; until the next time they go
        on with their velocity. `distance` is the least distance from their surfaces now [m].

        Parameters
        ----------
        **run : `RunOptions`.

        Raises
        ------
        ShapeError : start or goal within the clearance, and as of `Dmp.stepper`.
        """
        return AvoidingStepper(self, *self._resolved(run))

    def controller(
        self, limits: JointLimits | Sequence[JointLimits] | None = None, *, duration: float | None = None,
        g: ArrayLike | None = None,
    ) -> AvoidingController:  # fmt: skip
        """Return a controller of the robot, which starts where the arm is, at rest.

        Besides what `Controller` has, ``place(obstacles)`` says where all obstacles are now, before or during the run.

        Parameters
        ----------
        limits : as of `Dmp.controller`. duration, g : as of `Dmp.rollout`.

        Raises
        ------
        ConfigError : it has no robot. ShapeError : as of `stepper` and `Dmp.controller`.
        """
        return AvoidingController(self, {"duration": duration, "g": g}, limits)

    def _resolved(self, given: RunOptions) -> tuple[RunParameters, Any]:
        run, around = RunParameters.of(self.dmp, **given), self._around()
        self._check_clear("start", run.y0, around)
        self._check_clear("goal", run.g, around)
        return run, around

    def _check_clear(self, name: str, y: np.ndarray, around: Any) -> None:
        """Refuse a start or a goal that obstacles where they are now keep the motion from."""
        if not (least := float(around.distance(y))) > self.clearance:
            raise ShapeError(
                f"Expected the {name} outside the clearance of every obstacle, got one {least:.4g} m away. Move it, or "
                f"ask for less than {self.clearance:g} m."
            )


def rows_of(capsules: Iterable[Capsule], axes: int) -> np.ndarray:
    """Return rows (K, 10) of a kernel: ends, radius and velocity of K capsules in a space of 2 or 3 axes."""
    rows = []
    for i, one in enumerate(members(capsules, "capsules")):
        if not isinstance(one, Capsule):
            raise ShapeError(f"Expected capsules, got {one!r:.50} as number {i}. Make it a Capsule.")
        if len(one.a) != axes:
            raise ShapeError(f"Expected capsules in a space of {axes} axes, got number {i} of {len(one.a)}.")
        a, b, velocity = (np.append(x, np.zeros(3 - axes)) for x in (one.a, one.b, np.asarray(one.velocity)))
        rows.append(np.concatenate([a, b, [one.radius], velocity]))
    return np.array(rows).reshape(-1, 10)


def _bodies(robot: Robot, tool: Capsule | None, links: Mapping[int, Capsule]) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers (B,) of links and capsules (B, 7) in their axes; the tool is on the last."""
    T_link_tool = robot.chain.frames[-1]
    held = rows_of([tool or Capsule.sphere(np.zeros(3))], 3)[:, :7]
    for end in (slice(0, 3), slice(3, 6)):
        held[:, end] = held[:, end] @ T_link_tool[:3, :3].T + T_link_tool[:3, 3]
    wrong = [k for k in links if k not in range(1, robot.n + 1)]
    if wrong:
        raise ConfigError(f"Expected links from 1 to {robot.n}, got {wrong[0]!r}. `tool` is what the last one holds.")
    return np.array([robot.n, *links], dtype=float), np.concatenate([held, rows_of(links.values(), 3)[:, :7]])


class AvoidingStepper(Stepper):
    """One run of an `AvoidingDmp`, sample by sample; made by `AvoidingDmp.stepper`."""

    def __init__(self, avoiding: AvoidingDmp, run: RunParameters, around: Any) -> None:
        self._around, self._avoiding = around, avoiding
        super().__init__(run, around=around)

    def reset(self) -> None:
        """Go back to the start, with the first goal, duration and obstacles."""
        self.place(self._avoiding.obstacles)
        super().reset()

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Put obstacles where they are now; until the next time they go on with their velocity."""
        self._around.place(rows_of(obstacles, self._avoiding._axes))

    def change_goal(self, g: ArrayLike) -> None:
        """Go for another goal from now on."""
        self._avoiding._check_clear("goal", vector(g, "g", self._avoiding.n), self._around)
        super().change_goal(g)

    @property
    def distance(self) -> float:
        """Least distance from the surface of any obstacle now [m]."""
        return float(self._around.distance(self.state[0]))


class AvoidingController(DmpController):
    """An `AvoidingDmp` of joints as a controller; made by `AvoidingDmp.controller`.

    It ends the run where the arm starts within the clearance.
    """

    _dmp: AvoidingDmp
    _stepper: AvoidingStepper

    def __init__(
        self, avoiding: AvoidingDmp, settings: RunOptions, limits: JointLimits | Sequence[JointLimits] | None = None
    ) -> None:
        if avoiding.robot is None:
            raise ConfigError("Expected an AvoidingDmp of the joints of a robot, got one in space. Give robot=.")
        super().__init__(avoiding.robot, avoiding, settings, limits)

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Put obstacles where they are now, while it runs or before; see `AvoidingStepper.place`."""
        self._dmp = replace(self._dmp, obstacles=tuple(obstacles))
        self._stepper.place(self._dmp.obstacles)

    def columns(self) -> dict[str, Column]:
        """Return what it records, for ``link.run(extra=...)``."""
        from armlab.log import Column

        return super().columns() | {"distance": Column((), unit="m")}

    def _record(self) -> dict[str, Any]:
        return {"distance": np.float64(self._stepper.distance)}
