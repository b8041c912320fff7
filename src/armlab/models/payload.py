"""A load at the flange: its mass, its centre, its inertia, and what it adds to a torque model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from armlab._numbers import still
from armlab.errors import ModelMismatchError, ShapeError
from armlab.models.torque import TorqueModel
from armlab.robots import inertia


@dataclass(frozen=True, eq=False)
class Payload:
    """A load fixed rigidly to the flange of one robot.

    Attributes
    ----------
    robot_name, robot_hash : the robot that carried it.
    pi : (10,) m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the flange's origin, flange axes [kg, kg m, kg m^2].
    T_last_flange : (4, 4) the flange in the last link's frame.
    sources : SHA-256 and name of each log.
    """

    robot_name: str
    robot_hash: str
    pi: np.ndarray
    T_last_flange: np.ndarray
    sources: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays."""
        for name, shape in (("pi", (10,)), ("T_last_flange", (4, 4))):
            values = still(getattr(self, name), f"{name} of a payload")
            if values.shape != shape or not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {name} of shape {shape} of a payload, got shape {values.shape}.")
            object.__setattr__(self, name, values)

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.pi[0])

    @property
    def centre(self) -> np.ndarray:
        """Centre of mass (3,) in flange axes [m]; zero without mass."""
        return inertia.to_body(self.pi).centre

    @property
    def inertia(self) -> np.ndarray:
        """Inertia (3, 3) about the centre of mass, flange axes [kg m^2]."""
        return inertia.to_body(self.pi).inertia

    def added_to(self, model: TorqueModel) -> TorqueModel:
        """Return the torque model of the arm that carries this load: only its last link differs.

        The identified base parameters and their covariance stay those of the arm alone.

        Parameters
        ----------
        model : of the arm without the load.

        Raises
        ------
        ModelMismatchError : when the model belongs to another robot.
        """
        if model.robot_hash != self.robot_hash:
            raise ModelMismatchError(
                f"Expected a model of robot {self.robot_name!r} ({self.robot_hash[:12]}), got one of "
                f"{model.robot_name!r} ({model.robot_hash[:12]}). Fit the load again with this robot."
            )
        links = model.link_parameters.copy()
        links[-1] += inertia.transform(self.T_last_flange, self.pi)
        return replace(model, link_parameters=links)
