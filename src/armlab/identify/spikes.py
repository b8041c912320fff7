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
AT_ONCE = 4096  # rows: nine copies of them stay in the cache
# Exchanges after which the fifth of nine values is their median (Smith 1996, Implementing median filters in XC4000E).
EXCHANGES = "12 45 78 01 34 67 12 45 78 03 58 47 36 14 25 47 42 64 42"
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
    """Return the median (N, n) of nine samples around each, the first and last of a segment repeated."""
    out, reach = np.empty_like(x), WINDOW // 2
    for a, b in data.segments:
        wide = np.concatenate([np.repeat(x[a : a + 1], reach, axis=0), x[a:b], np.repeat(x[b - 1 : b], reach, axis=0)])
        for k in range(0, b - a, AT_ONCE):
            stop = min(k + AT_ONCE, b - a)
            around = [wide[k + j : stop + j] for j in range(WINDOW)]
            for i, j in (map(int, pair) for pair in EXCHANGES.split()):
                around[i], around[j] = np.minimum(around[i], around[j]), np.maximum(around[i], around[j])
            out[a + k : a + stop] = around[reach]
    return out


def _modelled(model: TorqueModel, data: Prepared) -> np.ndarray:
    """Return the torque (N, n) of the model; the acceleration is low-passed at a tenth of the rate."""
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    parts = [model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b]) for a, b in data.segments]
    return np.concatenate(parts)
