"""Motion: movement primitives that are taught by showing them once, and profiles from point to point."""

from armlab.motion import profiles
from armlab.motion.avoiding import AvoidingController, AvoidingStepper
from armlab.motion.control import Controller
from armlab.motion.controllers import DmpController, TwoDofController
from armlab.motion.dmp import Dmp
from armlab.motion.events import Displace, Hold, Push
from armlab.motion.fit import fit_dmp
from armlab.motion.limiting import duration_within, peaks
from armlab.motion.motion_band import MotionBand, blend
from armlab.motion.obstacles import AvoidingDmp, Capsule
from armlab.motion.pacing import PacedDmp, PacedStepper, within
from armlab.motion.periodic_controller import PeriodicController
from armlab.motion.periodic_dmp import PeriodicDmp
from armlab.motion.periodic_fit import fit_periodic_dmp
from armlab.motion.periodic_stepper import PeriodicStepper
from armlab.motion.pose_controller import PoseDmpController
from armlab.motion.pose_dmp import PoseDmp
from armlab.motion.pose_fit import fit_pose_dmp
from armlab.motion.pose_rollout import PoseRollout, PoseRunOptions
from armlab.motion.pose_stepper import PoseStepper
from armlab.motion.promp import ProMP
from armlab.motion.promp_fit import fit_promp
from armlab.motion.rollout import Rollout, RunOptions
from armlab.motion.stepper import Stepper
from armlab.motion.two_dof import TwoDofDmp
from armlab.motion.two_dof_run import TwoDofRun
from armlab.motion.two_dof_stepper import Reference, TwoDofStepper
from armlab.motion.via_points import through

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
    "MotionBand",
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
    "TwoDofController",
    "TwoDofDmp",
    "TwoDofRun",
    "TwoDofStepper",
    "blend",
    "duration_within",
    "fit_dmp",
    "fit_periodic_dmp",
    "fit_pose_dmp",
    "fit_promp",
    "peaks",
    "profiles",
    "through",
    "within",
]
