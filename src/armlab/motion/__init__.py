"""Motion: movement primitives that are taught by showing them once, and profiles from point to point."""

from armlab.motion import profiles
from armlab.motion.control import Controller
from armlab.motion.disturbances import Displace, Hold, Push, TwoDofRun
from armlab.motion.dmp import Dmp, DmpController
from armlab.motion.obstacles import AvoidingController, AvoidingDmp, AvoidingStepper, Capsule
from armlab.motion.periodic import PeriodicController, PeriodicDmp, PeriodicStepper, fit_periodic_dmp
from armlab.motion.pose_dmp import PoseDmp, PoseDmpController, PoseRollout, PoseRunOptions, PoseStepper
from armlab.motion.pose_fit import fit_pose_dmp
from armlab.motion.primitive.fit import fit_dmp
from armlab.motion.primitive.run import Rollout, RunOptions, Stepper
from armlab.motion.promp import ProMP, TrajectoryDistribution, blend, fit_promp
from armlab.motion.timing import PacedDmp, PacedStepper, peaks, retimed, shortest_duration
from armlab.motion.two_dof import Reference, TwoDofController, TwoDofDmp, TwoDofStepper
from armlab.motion.via_points import with_via_points

__all__ = [
    "AvoidingController",
    "AvoidingDmp",
    "AvoidingStepper",
    "Capsule",
    "Controller",
    "Displace",
    "Dmp",
    "DmpController",
    "Hold",
    "PacedDmp",
    "PacedStepper",
    "PeriodicController",
    "PeriodicDmp",
    "PeriodicStepper",
    "PoseDmp",
    "PoseDmpController",
    "PoseRollout",
    "PoseRunOptions",
    "PoseStepper",
    "ProMP",
    "Push",
    "Reference",
    "Rollout",
    "RunOptions",
    "Stepper",
    "TrajectoryDistribution",
    "TwoDofController",
    "TwoDofDmp",
    "TwoDofRun",
    "TwoDofStepper",
    "blend",
    "fit_dmp",
    "fit_periodic_dmp",
    "fit_pose_dmp",
    "fit_promp",
    "peaks",
    "profiles",
    "retimed",
    "shortest_duration",
    "with_via_points",
]
