"""Contact: the wrench of the environment on the robot, estimated from joint torques."""

from armlab.contact.comparison import Comparison, compare
from armlab.contact.estimator import Estimator
from armlab.contact.hypotheses import Hypotheses, hypotheses
from armlab.contact.intervals import Contact, contacts
from armlab.contact.wrench import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Wrench

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
