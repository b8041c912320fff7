"""Calibration cell with known ground truth: imperfect arm, camera, marker, force sensor and line scanner.

Each experiment has its own generator, ``default_rng([seed, run])``, so the same seed and run number produce the same
data in tests, benchmarks and examples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._display import Shown
from armlab.errors import ConfigError
from armlab.sim.experiments import kinematics, sensors
from armlab.sim.experiments.kinematics import DistanceRun, DualRun, KinematicRun
from armlab.sim.experiments.sensors import CAMERA, MovingSights, Poses, Scanned, Sights, Weighed, moving_sights


@dataclass(frozen=True, repr=False)
class CalibrationCell(Shown):
    """Calibration experiments with known ground truth, one method per experiment.

    An experiment contains the recorded data, the ground truth, and `given`, the arguments for the matching fit.

    Attributes
    ----------
    seed : seed of all experiments.
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
        """Generate robot poses A and marker poses B in the camera frame, with ``A X = Y B``.

        Parameters
        ----------
        run : number of the experiment.
        N : number of poses.
        tilt : maximum tilt of the tool from a fixed orientation [rad]; None: any orientation.
        camera : noise of B (position [m], rotation [rad]).
        robot : noise of A (position [m], rotation [rad]); None: exact.
        wrong : number of outliers: the first marker poses are rotated by 10 degrees and moved by 50 mm.
        """
        return sensors.seen_poses([self.seed, run], N, tilt, camera, robot, wrong)

    def moving_hand_eye(self, run: int = 0, N: int = 60, *, jitter: float = 0.01) -> MovingSights:
        """Simulate two recordings of a moving arm: joint positions at 250 Hz, and camera images with a jittering
        `clock`.

        Parameters
        ----------
        run : number of the experiment.
        N : number of images, at 10 Hz.
        jitter : jitter of the image times [s].
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
        """Generate robot poses and three points of a marker seen by a camera.

        Parameters
        ----------
        run : number of the experiment.
        N : number of poses.
        sigma : noise of each coordinate [m].
        missing : fraction of missing points.
        robot : noise of the robot poses (position [m], rotation [rad]); None: exact.
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
        """Generate tool orientations RA and readings y of a force sensor with a load of 1 kg.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
        sigma : noise of the forces [N].
        tilt : maximum tilt of the tool from a fixed orientation [rad]; None: any orientation.
        torque : noise of the torques [N m]; None: forces only.
        unknown : whether the gravity direction is random.
        bias : whether to add a random sensor bias.
        contacts : number of initial samples with a contact force of 20 N.
        """
        return sensors.weighed([self.seed, run], N, sigma, tilt, torque, unknown, bias, contacts)

    def accelerometer(self, run: int = 0, N: int = 50, *, sigma: float = 0.02) -> Weighed:
        """Generate tool orientations RA and readings y of an accelerometer at rest.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
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
        """Generate joint positions `q` of an IRB 2400 with kinematic errors, and measured tool poses `pose`.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
        truth : "lpoe" for errors in every frame of the arm, "dh" for errors in every DH parameter.
        tool : whether the nominal tool is offset from the flange.
        harmonics : whether to add joint errors of orders 1 and 2 with amplitudes of about 0.02 deg.
        wrong : number of outliers: the first poses are rotated by 2 degrees and moved by 20 mm.

        Raises
        ------
        ConfigError : unknown `truth`.
        """
        if truth not in ("lpoe", "dh"):
            raise ConfigError(f"Expected truth 'lpoe' or 'dh', got {truth!r}.")
        return kinematics.kinematic_run(run, self.seed, N, truth, tool, harmonics, wrong)

    def distances(self, run: int = 0, N: int = 120) -> DistanceRun:
        """Generate an anchor point and its distances from the tool of the arm in `kinematics`, with 0.05 mm of noise.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
        """
        return kinematics.distance_run(run, self.seed, N)

    def two_arms(self, run: int = 0, N: int = 60, *, wrong: int = 0) -> DualRun:
        """Generate joint positions of two arms facing each other, and poses of one tool relative to the other.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
        wrong : number of outliers: the first poses are rotated by 2 degrees and moved by 20 mm.
        """
        return kinematics.dual_run(run, self.seed, N, wrong)

    def laser(self, run: int = 0, N: int = 60, *, size: float = 1.0, plates: int = 3, wrong: int = 0) -> Scanned:
        """Generate tool poses A and the lines `scans` that a scanner on the tool measures on plates (index `plane`).

        Parameters
        ----------
        run : number of the experiment.
        N : number of scans.
        size : scale of the noise; 1 corresponds to 0.5 mm.
        plates : number of plates, one to three, scanned in turn.
        wrong : number of outliers: the first scans are moved by 20 mm and rotated by 10 degrees.

        Raises
        ------
        ConfigError : if `plates` is not one to three.
        """
        if not 1 <= plates <= 3:
            raise ConfigError(f"Expected one to three plates, got {plates}. Choose a number in this range.")
        return sensors.scanned([self.seed, run], N, size, plates, wrong)

    def clock(self, run: int = 0, N: int = 30, *, period: float = 0.1, jitter: float = 1e-3) -> np.ndarray:
        """Generate the times (N,) [s] of a sensor with clock jitter: ``t_k = k period + e_k``, increasing.

        Parameters
        ----------
        run : number of the experiment.
        N : number of samples.
        period : period of the sensor [s].
        jitter : standard deviation of e [s]; e is limited to 0.4 periods.
        """
        e = jitter * np.random.default_rng([self.seed, run]).standard_normal(N)
        return period * np.arange(N) + np.clip(e, -0.4 * period, 0.4 * period)


def cell(seed: int) -> CalibrationCell:
    """Return the calibration cell for a seed.

    Parameters
    ----------
    seed : seed of at least 0; equal seeds give equal experiments.

    Raises
    ------
    ConfigError : if the seed is negative.

    Examples
    --------
    >>> seen = cell(1).hand_eye(N=20)
    >>> seen.A.shape, seen.B.shape
    ((20, 4, 4), (20, 4, 4))
    """
    if seed < 0:
        raise ConfigError(f"Expected a seed of at least 0, got {seed}. Choose a larger seed.")
    return CalibrationCell(seed)
