"""Contact: the wrench of the environment on the robot, estimated from joint torques."""

from armlab.contact.contacts import compare, contacts, hypotheses
from armlab.contact.estimator import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Estimator, Wrench

__all__ = [
    "INFEASIBLE",
    "INVALID",
    "SINGULAR",
    "STUCK",
    "TARED",
    "WEAK",
    "Estimator",
    "Wrench",
    "compare",
    "contacts",
    "hypotheses",
]
