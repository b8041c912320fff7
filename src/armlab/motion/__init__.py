"""Motion: movement primitives that are taught by showing them once, and profiles from point to point."""

from armlab.models import register
from armlab.motion import profiles
from armlab.motion.dmp import Dmp
from armlab.motion.fit import fit_dmp
from armlab.motion.rollout import Rollout
from armlab.motion.stepper import Stepper

__all__ = ["Dmp", "Rollout", "Stepper", "fit_dmp", "profiles"]

register("dmp", Dmp)
