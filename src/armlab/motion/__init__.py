"""Motion: movement primitives learned from demonstrations, point-to-point profiles, and trajectories."""

from armlab.motion import profiles
from armlab.motion.control import Controller
from armlab.motion.disturbances import Displace, Hold, Push, TwoDofRun
from armlab.motion.dmp import Dmp, with_via_points
from armlab.motion.obstacles import AvoidingDmp, Capsule
from armlab.motion.periodic import PeriodicDmp, fit_periodic_dmp
from armlab.motion.pose_dmp import PoseDmp, PoseRollout, fit_pose_dmp
from armlab.motion.primitive.fit import fit_dmp
from armlab.motion.primitive.run import Rollout, Stepper
from armlab.motion.promp import ProMP, TrajectoryDistribution, blend, fit_promp
from armlab.motion.timing import PacedDmp, retimed, shortest_duration
from armlab.motion.trajectory import JointTrajectory, Tolerance, TrajectoryController
from armlab.motion.two_dof import TwoDofDmp

__all__ = [
    "AvoidingDmp",
    "Capsule",
    "Controller",
    "Displace",
    "Dmp",
    "Hold",
    "JointTrajectory",
    "PacedDmp",
    "PeriodicDmp",
    "PoseDmp",
    "PoseRollout",
    "ProMP",
    "Push",
    "Rollout",
    "Stepper",
    "Tolerance",
    "TrajectoryController",
    "TrajectoryDistribution",
    "TwoDofDmp",
    "TwoDofRun",
    "blend",
    "fit_dmp",
    "fit_periodic_dmp",
    "fit_pose_dmp",
    "fit_promp",
    "profiles",
    "retimed",
    "shortest_duration",
    "with_via_points",
]
