"""Contact: the wrench of the environment on the robot, estimated from joint torques."""

from armlab.contact.estimator import Estimator
from armlab.contact.intervals import Contact, contacts
from armlab.contact.wrench import INFEASIBLE, INVALID, SINGULAR, STUCK, WEAK, Wrench

__all__ = [
    "INFEASIBLE",
    "INVALID",
    "SINGULAR",
    "STUCK",
    "WEAK",
    "Contact",
    "Estimator",
    "Wrench",
    "contacts",
]
