"""The cell of known truth: an arm that is not quite its table, a camera, a marker, a force sensor, a line scanner.

Each experiment is drawn by a generator of its own, ``default_rng([seed, run])``, in the order of its terms, so that the
same numbers give the same data everywhere: in tests, benchmarks and examples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import ConfigError
from armlab.sim.experiments import kinematics, sensors
from armlab.sim.experiments.kinematics import DistanceRun, DualRun, KinematicRun
from armlab.sim.experiments.sensors import CAMERA, MovingSights, Poses, Scanned, Sights, Weighed, moving_sights


@dataclass(frozen=True)
class CalibrationCell:
    """Experiments of calibration whose truth is known; each method draws one.

    An experiment has what a robot and its sensors would have recorded, the truth behind it, and `given`, the arguments
    of the fit that it is made for.

    Attributes
    ----------
    seed : of all experiments.
    """

    seed: int

    def hand_eye(
        self,
        run: int = 0,
        N: int = 30,
        *,
        tilt: float | None = None,
        camera: tuple[float, float] = CAMERA,
        robot: tuple[float, float] | None = None,
        wrong: int = 0,
    ) -> Poses:
        """Draw poses of a robot (A) and of a marker that a camera sees (B), ``A X = Y B``.

        Parameters
        ----------
        run : number of the experiment. N : poses.
        tilt : largest angle of the tool from one orientation [rad]; any orientation when None.
        camera : noise of B (m, rad).
        robot : noise of A; exact when None.
        wrong : how many of the first poses of the marker are turned by 10 degrees and moved by 50 mm.
        """
        return sensors.seen_poses([self.seed, run], N, tilt, camera, robot, wrong)

    def moving_hand_eye(self, run: int = 0, N: int = 60, *, jitter: float = 0.01) -> MovingSights:
        """Draw two recordings of an arm that moves: its joints at 250 Hz, and a camera whose `clock` jitters.

        Parameters
        ----------
        run : number of the experiment. N : images, ten per second.
        jitter : of their times [s].
        """
        return moving_sights([self.seed, run, 1], self.clock(run, N, jitter=jitter))

    def marker_points(
        self,
        run: int = 0,
        N: int = 100,
        *,
        sigma: float = 0.5e-3,
        missing: float = 0.2,
        robot: tuple[float, float] | None = None,
    ) -> Sights:
        """Draw poses of a robot and three points of a marker that a camera sees.

        Parameters
        ----------
        run : number of the experiment. N : poses.
        sigma : noise of each coordinate [m].
        missing : share not seen.
        robot : noise of the robot's poses (position [m], rotation [rad]); exact when None.
        """
        return sensors.seen_points([self.seed, run], N, sigma, missing, robot)

    def force(
        self,
        run: int = 0,
        N: int = 100,
        *,
        sigma: float = 0.1,
        tilt: float | None = None,
        torque: float | None = None,
        unknown: bool = False,
        bias: bool = True,
        contacts: int = 0,
    ) -> Weighed:
        """Draw orientations of a tool (RA) and readings (y) of a force sensor that carries 1 kg.

        Parameters
        ----------
        run : number of the experiment. N : samples.
        sigma : noise of forces [N].
        tilt : largest angle of the tool from one orientation [rad]; any orientation when None.
        torque : noise of torques [N m]; forces alone when None.
        unknown : the weight points anywhere.
        bias : readings without weight are not zero.
        contacts : how many of the first samples have a contact of 20 N.
        """
        return sensors.weighed([self.seed, run], N, sigma, tilt, torque, unknown, bias, contacts)

    def accelerometer(self, run: int = 0, N: int = 50, *, sigma: float = 0.02) -> Weighed:
        """Draw orientations of a tool (RA) and readings (y) of an accelerometer at rest.

        Parameters
        ----------
        run : number of the experiment. N : samples.
        sigma : noise [m/s^2].
        """
        return sensors.accelerated([self.seed, run], N, sigma)

    def kinematics(
        self,
        run: int = 0,
        N: int = 50,
        *,
        truth: str = "lpoe",
        tool: bool = True,
        harmonics: bool = False,
        wrong: int = 0,
    ) -> KinematicRun:
        """Draw joint positions (q) of an IRB 2400 that is not quite its table, and measured poses of its tool (pose).

        Parameters
        ----------
        run : number of the experiment. N : samples.
        truth : "lpoe", every frame of the arm moved; "dh", every number of its table.
        tool : the nominal tool is away from the flange.
        harmonics : joints with errors of orders 1 and 2, 0.02 deg.
        wrong : how many of the first poses are turned by 2 degrees and moved by 20 mm.

        Raises
        ------
        ConfigError : another truth.
        """
        if truth not in ("lpoe", "dh"):
            raise ConfigError(f"Expected the truth 'lpoe' or 'dh' of an arm, got {truth!r}. Take one of the two.")
        return kinematics.kinematic_run(run, self.seed, N, truth, tool, harmonics, wrong)

    def distances(self, run: int = 0, N: int = 120) -> DistanceRun:
        """Draw the same, a fixed point (anchor) and its distances from the tool (distance), with 0.05 mm of noise.

        Parameters
        ----------
        run : number of the experiment. N : samples.
        """
        return kinematics.distance_run(run, self.seed, N)

    def two_arms(self, run: int = 0, N: int = 60, *, wrong: int = 0) -> DualRun:
        """Draw joint positions of two arms that face each other and poses of the one tool seen from the other.

        Parameters
        ----------
        run : number of the experiment. N : samples.
        wrong : how many of the first poses are turned by 2 degrees and moved by 20 mm.
        """
        return kinematics.dual_run(run, self.seed, N, wrong)

    def laser(self, run: int = 0, N: int = 60, *, size: float = 1.0, plates: int = 3, wrong: int = 0) -> Scanned:
        """Draw poses of a tool (A) and lines (scans) that a scanner on it sees on flat plates (plane).

        Parameters
        ----------
        run : number of the experiment. N : scans.
        size : of the noise; 1 is 0.5 mm.
        plates : one to three, in turn.
        wrong : how many of the first scans are moved by 20 mm and turned by 10 degrees.

        Raises
        ------
        ConfigError : another number of plates.
        """
        if not 1 <= plates <= 3:
            raise ConfigError(f"Expected one to three plates, got {plates}. The cell has three.")
        return sensors.scanned([self.seed, run], N, size, plates, wrong)

    def clock(self, run: int = 0, N: int = 30, *, period: float = 0.1, jitter: float = 1e-3) -> np.ndarray:
        """Draw the times (N,) [s] of a sensor whose clock jitters: ``t_k = k period + e_k``, increasing.

        Parameters
        ----------
        run : number of the experiment. N : samples.
        period : of the sensor [s].
        jitter : standard deviation of e [s], cut at 0.4 periods.
        """
        e = jitter * np.random.default_rng([self.seed, run]).standard_normal(N)
        return period * np.arange(N) + np.clip(e, -0.4 * period, 0.4 * period)


def cell(seed: int) -> CalibrationCell:
    """Return the cell of known truth of a seed.

    Parameters
    ----------
    seed : from 0; the same seed gives the same experiments.

    Raises
    ------
    ConfigError : a negative seed.

    Examples
    --------
    >>> seen = cell(1).hand_eye(N=20)
    >>> seen.A.shape, seen.B.shape
    ((20, 4, 4), (20, 4, 4))
    """
    if seed < 0:
        raise ConfigError(f"Expected a seed from 0, got {seed}. Take another one.")
    return CalibrationCell(seed)
