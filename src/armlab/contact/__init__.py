"""Contact: the wrench of the environment on the robot, estimated from joint torques."""

from armlab.contact.estimator import Estimator
from armlab.contact.wrench import INVALID, WEAK, Wrench

__all__ = ["INVALID", "WEAK", "Estimator", "Wrench"]
