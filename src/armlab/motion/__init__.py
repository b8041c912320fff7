"""Motion: movement primitives that are taught by showing them once, and profiles from point to point."""

from armlab.models import register
from armlab.motion import profiles
from armlab.motion.control import Controller
from armlab.motion.controllers import DmpController, TwoDofController
from armlab.motion.dmp import Dmp
from armlab.motion.events import Displace, Hold, Push
from armlab.motion.fit import fit_dmp
from armlab.motion.rollout import Rollout
from armlab.motion.stepper import Stepper
from armlab.motion.two_dof import TwoDofDmp
from armlab.motion.two_dof_run import TwoDofRun
from armlab.motion.two_dof_stepper import Reference, TwoDofStepper

__all__ = [
    "Controller",
    "Displace",
    "Dmp",
    "DmpController",
    "Hold",
    "Push",
    "Reference",
    "Rollout",
    "Stepper",
    "TwoDofController",
    "TwoDofDmp",
    "TwoDofRun",
    "TwoDofStepper",
    "fit_dmp",
    "profiles",
]

register("dmp", Dmp)
