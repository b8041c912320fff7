"""What is identified, saved, and later run: friction, ripple, torque covariance, the torque model, force sensors."""

from armlab.models.accelerometer import Accelerometer
from armlab.models.coupled import CoupledMotors
from armlab.models.files import load, load_statistics, save
from armlab.models.force_sensor import ForceSensor
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.hand_eye import HandEye
from armlab.models.kinematic_correction import DualArmCorrection, KinematicCorrection, harmonic_basis
from armlab.models.laser_sensor import LaserSensor
from armlab.models.momentum import FORCE_RATES, PRIOR, MomentumNoise
from armlab.models.payload import Payload
from armlab.models.quality import Quality
from armlab.models.rbf import FrictionMap, RadialBasis
from armlab.models.registry import register
from armlab.models.ripple import RippleLines, speed_basis
from armlab.models.torque import TorqueModel
from armlab.models.training import SPEED_EDGES, Training
from armlab.models.velocity_covariance import VelocityCovariance, velocity_covariance
from armlab.models.warm_up import WarmUp
from armlab.robots import Mesh, Robot

__all__ = [
    "FORCE_RATES",
    "PRIOR",
    "SPEED_EDGES",
    "Accelerometer",
    "CoupledMotors",
    "ForceSensor",
    "DualArmCorrection",
    "Friction",
    "FrictionBound",
    "FrictionMap",
    "HandEye",
    "KinematicCorrection",
    "LaserSensor",
    "MomentumNoise",
    "Payload",
    "Quality",
    "RadialBasis",
    "Ripple",
    "RippleLines",
    "TorqueModel",
    "Training",
    "VelocityCovariance",
    "WarmUp",
    "harmonic_basis",
    "load",
    "load_statistics",
    "register",
    "save",
    "speed_basis",
    "velocity_covariance",
]

register("velocity_covariance", VelocityCovariance)
register("ripple_lines", RippleLines)
register("radial_basis", RadialBasis)
register("friction_map", FrictionMap)
register("warm_up", WarmUp)
register("momentum_noise", MomentumNoise)
register("coupled_motors", CoupledMotors)
register("payload", Payload)
register("force_sensor", ForceSensor)
register("hand_eye", HandEye)
register("robot", Robot)
register("mesh", Mesh)
register("kinematic_correction", KinematicCorrection)
register("dual_arm_correction", DualArmCorrection)
register("accelerometer", Accelerometer)
register("laser_sensor", LaserSensor)
