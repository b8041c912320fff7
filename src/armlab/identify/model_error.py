"""What is uncertain in an identified model, and what fits that rely on the model make of it.

Where the residual ``y = tau - tau_model`` is fitted by ``y = A x + e``, an error d of the model's parameters adds
``-C d`` to e, with C = d tau_model / d parameters. All rows share one d: no number of rows averages it out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from armlab.estimation import Fit
from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.identify.preparation import Prepared
from armlab.kernels import presliding
from armlab.models import Friction, TorqueModel
from armlab.robots import Robot

__all__ = ["ModelError"]

CHUNK = 4096  # rows whose whole regressor is held at once
STEP = 1e-3  # of the logarithm of what the torque is not linear in
FIELDS = {
    "viscous": ("viscous",),
    "coulomb": ("coulomb_pos", "coulomb_neg"),
    "coulomb+": ("coulomb_pos",),
    "coulomb-": ("coulomb_neg",),
    "offset": ("offset",),
    "stribeck": ("stribeck",),
    "root": ("root",),
    "delta": ("delta",),
    "tanh-speed": ("smooth_speed",),
    "stribeck-speed": ("stribeck_speed",),
}
CURVED = ("delta", "tanh-speed", "stribeck-speed")
RIPPLE = {"ripple cos": np.cos, "ripple sin": np.sin}


@dataclass(frozen=True, eq=False)
class ModelError:
    """The uncertain parameters of a model.

    Attributes
    ----------
    model : the model. robot : its arm.
    base : its base parameters, or None for those of an arm of which some joints were left out.
    names : of the P parameters that are propagated. cov : (P, P) their covariance.
    left_out : names of those that are not.
    """

    model: TorqueModel
    robot: Robot
    base: BaseParameters | None
    names: tuple[str, ...]
    cov: np.ndarray
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, known: TorqueModel | Fit[TorqueModel], robot: Robot) -> ModelError:
        """Return what is uncertain in a model: rigid body and friction of a fit, the rigid body alone of a model.

        Parameters
        ----------
        known : as `identify.fit_dynamics` or `fit_gravity` return it, or its value. robot : the arm.
        """
        model = known.value if isinstance(known, Fit) else known
        names, cov = (known.names, _apart(known)) if isinstance(known, Fit) else (model.base_names, model.base_cov)
        bases = base_parameters(robot), base_parameters(robot, quasi_static=True)
        base = next((base for base in bases if base.names == tuple(model.base_names)), None)
        own = {name for terms in _own_names(robot, base).values() for name in terms}
        rigid = set() if base is None else set(base.names)
        index = [k for k, name in enumerate(names) if name in own | rigid]
        left_out = tuple(name for name in names if name not in own | rigid)
        return cls(model, robot, base, tuple(names[k] for k in index), cov[np.ix_(index, index)], left_out)

    def against(self, A: np.ndarray, data: Prepared, rows: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return the sums (J, w, P) of A_i^T C_i per joint: how columns take up what is wrong with the model.

        Parameters
        ----------
        A : (M, J, w) filtered columns. data : the record. rows : (M,) of it that are kept. joints : (J,) numbers.
        """
        total = np.zeros((len(joints), A.shape[2], len(self.names)))
        at = {name: k for k, name in enumerate(self.names)}
        if self.base is not None:
            rigid = [at[name] for name in self.base.names]
            total[:, :, rigid] = _rigid(A, data, rows, joints, self.robot, self.base)
        for names, slope in self._own(data, set(self.names)):
            column = data.filter(slope, data.rate / 10.0)[rows]
            for i, joint in enumerate(joints):
                if names[joint] in at:
                    total[i, :, at[names[joint]]] = A[:, i].T @ column[:, joint]
        return total

    def _own(self, data: Prepared, wanted: set[str]) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
        """Yield the names (n,) of one term of all joints, and its slope (N, n)."""
        friction, ripple = self.model.friction, self.model.ripple
        for term, names in _own_names(self.robot, self.base).items():
            if wanted.isdisjoint(names):
                continue
            if term in RIPPLE:
                yield names, RIPPLE[term](ripple.cycles * data.q)
                continue
            ends = []
            for sign in (1.0, -1.0):
                fields = {name: getattr(friction, name) for name in FIELDS[term]}
                moved = {k: x * np.exp(sign * STEP) if term in CURVED else x + sign for k, x in fields.items()}
                ends.append(_friction(replace(friction, **moved), data))
            width = 2.0
            if term in CURVED:
                value = getattr(friction, FIELDS[term][0])
                width = 2.0 * np.sinh(STEP) * np.where(value > 0, value, 1.0)
            yield names, (ends[0] - ends[1]) / width


def _apart(fit: Fit[TorqueModel]) -> np.ndarray:
    """Return the covariance of a fit without what its gains have in common.

    Gains that are all c too large leave parameters that are all c too small, and the torque that is read the same.
    """
    gain_cov = fit.value.gain_cov
    told = np.flatnonzero(np.diag(gain_cov) > 0)
    if not len(told):
        return fit.cov
    ones = np.ones(len(told))
    common = 1.0 / (ones @ np.linalg.solve(gain_cov[np.ix_(told, told)], ones))
    scaled = np.array([0.0 if name.split()[0] in CURVED else x for name, x in zip(fit.names, fit.parameters)])
    return fit.cov - common * np.outer(scaled, scaled)


def _own_names(robot: Robot, base: BaseParameters | None) -> dict[str, tuple[str, ...]]:
    """Return the names (n,) of each term that joints have of their own."""
    names = {term: tuple(f"{term} {joint}" for joint in robot.joint_names) for term in (*FIELDS, *RIPPLE)}
    return names if base is None else {**names, "offset": tuple(base.offset_names)}


def _friction(friction: Friction, data: Prepared) -> np.ndarray:
    """Return the torque (N, n) of friction along a record, each segment from rest."""
    torque = np.empty_like(data.q)
    for a, b in data.segments:
        z = presliding(data.q[a:b], friction.delta, friction.resolution)
        torque[a:b] = friction.torque(data.qd[a:b], z)
    return torque


def _rigid(
    A: np.ndarray, data: Prepared, rows: np.ndarray, joints: np.ndarray, robot: Robot, base: BaseParameters
) -> np.ndarray:
    """Return the sums (J, w, p) over columns of the base parameters."""
    n, moves = robot.n, 0.0 if base.quasi_static else 1.0
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    total = np.zeros((len(joints), A.shape[2], len(base.names)))
    for a in range(0, len(rows), CHUNK):
        part = rows[a : a + CHUNK]
        Y = robot.chain.rigid_regressor(data.q[part], moves * data.qd[part], moves * qdd[part], robot.gravity)
        Y = Y @ base.lift[: 10 * n] + qdd[part][:, :, None] * base.lift[10 * n :]
        total += A[a : a + CHUNK].transpose(1, 2, 0) @ Y[:, joints].transpose(1, 0, 2)
    return total
