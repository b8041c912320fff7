"""Contact: the wrench of the environment on the robot, estimated from joint torques."""

from armlab.contact.contacts import Comparison, Contact, compare, contacts
from armlab.contact.estimator import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Estimator, Wrench
from armlab.contact.hypotheses import Hypotheses, hypotheses

__all__ = [
    "INFEASIBLE",
    "INVALID",
    "SINGULAR",
    "STUCK",
    "TARED",
    "WEAK",
    "Comparison",
    "Contact",
    "Estimator",
    "Hypotheses",
    "Wrench",
    "compare",
    "contacts",
    "hypotheses",
]
