"""Single samples of torque that are far from their neighbours, found and replaced.

A filter would spread a spike over its neighbours, where no loss function finds it again. The median of the neighbours
is a first guess, wrong by several deviations where friction turns round; once there is a model, its torque is taken
there, plus the median of what it leaves of the neighbours.
"""

from __future__ import annotations

import numpy as np

from armlab.identify.preparation import Prepared
from armlab.models import TorqueModel

__all__ = ["spikes", "without_spikes"]

SPIKE, WINDOW = 6.0, 9  # robust deviations from the median of so many samples
NORMAL_MAD = 0.6744897501960817  # median of |x| for x ~ N(0, 1)


def spikes(data: Prepared) -> np.ndarray:
    """Return which torques (N, n) are six robust deviations or more from the median of nine samples around them.

    Parameters
    ----------
    data : the record.
    """
    away = np.abs(data.tau - _median(data.tau, data))
    found = np.zeros(away.shape, dtype=bool)
    for a, b in data.segments:
        scale = np.median(away[a:b], axis=0) / NORMAL_MAD
        found[a:b] = (away[a:b] > SPIKE * scale) & (scale > 0)
    return found


def without_spikes(data: Prepared, found: np.ndarray, model: TorqueModel | None = None) -> np.ndarray:
    """Return the torque (N, n) with spikes replaced by the model's, plus the median of what it leaves around them.

    Parameters
    ----------
    data : the record. found : (N, n) from `spikes`. model : of the arm; the median of the torque alone when left out.
    """
    known = np.zeros_like(data.tau) if model is None else _modelled(model, data)
    return np.where(found, known + _median(data.tau - known, data), data.tau)


def _median(x: np.ndarray, data: Prepared) -> np.ndarray:
    from scipy.ndimage import median_filter

    return np.concatenate([median_filter(x[a:b], size=(WINDOW, 1), mode="nearest") for a, b in data.segments])


def _modelled(model: TorqueModel, data: Prepared) -> np.ndarray:
    """Return the torque (N, n) of the model; the acceleration is low-passed at a tenth of the rate."""
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    parts = [model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b]) for a, b in data.segments]
    return np.concatenate(parts)
