"""What is identified, saved, and later run: friction, ripple, torque covariance, the torque model, force sensors."""

from armlab.models.files import load, load_statistics, register, save
from armlab.models.friction import (
    Friction,
    FrictionBound,
    FrictionMap,
    RadialBasis,
    Ripple,
    RippleLines,
    WarmUp,
    speed_basis,
)
from armlab.models.hand_eye import HandEye
from armlab.models.kinematic_correction import DualArmCorrection, KinematicCorrection, harmonic_basis
from armlab.models.noise import FORCE_RATES, PRIOR, MomentumNoise, VelocityCovariance, velocity_covariance
from armlab.models.payload import Payload
from armlab.models.sensors import Accelerometer, ForceSensor, LaserSensor
from armlab.models.torque import SPEED_EDGES, CoupledMotors, Quality, TorqueModel, Training
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
