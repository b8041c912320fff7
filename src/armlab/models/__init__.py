"""What is identified, saved, and later run: friction, ripple, torque covariance, the torque model and its file."""

from armlab.models.files import load, load_statistics, save
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.registry import register
from armlab.models.torque import Quality, TorqueModel
from armlab.models.velocity_covariance import VelocityCovariance, velocity_covariance

__all__ = [
    "Friction",
    "FrictionBound",
    "Quality",
    "Ripple",
    "TorqueModel",
    "VelocityCovariance",
    "load",
    "load_statistics",
    "register",
    "save",
    "velocity_covariance",
]

register("velocity_covariance", VelocityCovariance)
