"""Identified models that are saved and used at run time: friction, ripple, torque covariance, torque model, sensors."""

from armlab.models.files import load, register, save
from armlab.models.friction import Friction, FrictionBound, FrictionMap, RadialBasis, RippleLines, WarmUp
from armlab.models.kinematic_correction import DualArmCorrection, KinematicCorrection
from armlab.models.sensors import Accelerometer, ForceSensor, HandEye, LaserSensor
from armlab.models.torque import CoupledMotors, Payload, Quality, TorqueModel
from armlab.models.uncertainty import MomentumNoise, ParameterCovariance, VelocityCovariance, velocity_covariance
from armlab.robots import Mesh, Robot

__all__ = [
    "Accelerometer",
    "DualArmCorrection",
    "ForceSensor",
    "Friction",
    "FrictionBound",
    "FrictionMap",
    "HandEye",
    "KinematicCorrection",
    "LaserSensor",
    "Payload",
    "Quality",
    "RippleLines",
    "TorqueModel",
    "VelocityCovariance",
    "WarmUp",
    "load",
    "register",
    "save",
    "velocity_covariance",
]

register("velocity_covariance", VelocityCovariance)
register("ripple_lines", RippleLines)
register("radial_basis", RadialBasis)
register("friction_map", FrictionMap)
register("warm_up", WarmUp)
register("momentum_noise", MomentumNoise)
register("coupled_motors", CoupledMotors)
register("parameter_covariance", ParameterCovariance)
register("payload", Payload)
register("force_sensor", ForceSensor)
register("hand_eye", HandEye)
register("robot", Robot)
register("mesh", Mesh)
register("kinematic_correction", KinematicCorrection)
register("dual_arm_correction", DualArmCorrection)
register("accelerometer", Accelerometer)
register("laser_sensor", LaserSensor)
