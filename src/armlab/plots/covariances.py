"""The uncertainty of a torque model over velocity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.glossary import lookup
from armlab.models import TorqueModel, VelocityCovariance
from armlab.plots.style import JOINT_STYLES, legend, look, panels
from armlab.plots.torques import value_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from armlab.estimation import Fit

__all__ = ["velocity_covariance"]

_POINTS = 601


def velocity_covariance(
    model: Fit[TorqueModel] | TorqueModel | VelocityCovariance, qd_max: float = 1.0, ax: Any = None
) -> Axes:
    """Draw the standard deviation of each joint's torque error over its velocity: wide at rest, narrow in motion.

    Parameters
    ----------
    model : a torque model, the fit that has it, or its covariance alone.
    qd_max : the figure goes from -qd_max to qd_max [rad/s].
    ax : Axes to draw into; a new figure when None.

    Returns
    -------
    The Axes.

    Raises
    ------
    ModelMismatchError : something else in place of a model.
    """
    covariance = model if isinstance(model, VelocityCovariance) else value_of(model).covariance
    joints = len(covariance.C0)
    qd = np.linspace(-qd_max, qd_max, _POINTS)
    sigma = np.sqrt(covariance.variance(np.repeat(qd[:, None], joints, axis=1)))
    with look():
        figure, axes = panels(1, 1, ax, width=7.5, height=4.0)
        panel: Axes = axes[0, 0]
        for i in range(joints):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            panel.plot(qd, sigma[:, i], color=color, linestyle=style, linewidth=1.4, label=f"joint {i + 1}")
        panel.set_yscale("log")
        panel.set_xlabel(f"qd [{lookup('qd').unit}]")
        panel.set_ylabel(f"sigma of the torque error [{lookup('tau').unit}]")
        panel.set_ylim(0.7 * sigma.min(), 1.4 * sigma.max())
        legend(figure, panel)
    return panel
