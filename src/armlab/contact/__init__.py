"""Contact wrench estimation: the wrench exerted by the environment on the robot, from joint torques."""

from armlab.contact.contacts import Comparison, Contact, Hypotheses, compare, contacts, hypotheses
from armlab.contact.estimator import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Estimator, Wrench

__all__ = [
    "Comparison",
    "Contact",
    "Estimator",
    "Hypotheses",
    "INFEASIBLE",
    "INVALID",
    "SINGULAR",
    "STUCK",
    "TARED",
    "WEAK",
    "Wrench",
    "compare",
    "contacts",
    "hypotheses",
]
