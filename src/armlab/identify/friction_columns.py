"""Columns of a regression over joint torque that depend on the shape of friction, filtered and thinned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.identify.thinning import Thinning
from armlab.kernels import presliding

__all__ = ["Bell", "FrictionColumns"]


@dataclass(frozen=True, eq=False)
class Bell:
    """The factor exp(-(qd / v_s)^2), made of the rows that are asked for.

    Attributes
    ----------
    qd : (N, J) velocities. speed : (J,) v_s of Stribeck's term.
    """

    qd: np.ndarray
    speed: np.ndarray

    def __getitem__(self, rows: slice) -> np.ndarray:
        """Return it for some rows."""
        return np.exp(-((self.qd[rows] / self.speed) ** 2))


@dataclass(frozen=True, eq=False)
class FrictionColumns:
    """Makes the columns of friction of J joints from their motion.

    Attributes
    ----------
    thinning : filter of the record, with the (M,) rows that are kept.
    q, qd : (N, J) positions and velocities. resolution : (J,) half the smallest step of the encoder [rad].
    """

    thinning: Thinning
    q: np.ndarray
    qd: np.ndarray
    resolution: np.ndarray

    def of(self, i: int) -> FrictionColumns:
        """Return those of one joint, i from 0."""
        one = slice(i, i + 1)
        q, qd = np.ascontiguousarray(self.q[:, one]), np.ascontiguousarray(self.qd[:, one])
        return FrictionColumns(self.thinning, q, qd, self.resolution[one])

    def sign(self, delta: np.ndarray, smooth: np.ndarray) -> np.ndarray:
        """Return s (N, J) along the record: presliding state, or smooth sign.

        Parameters
        ----------
        delta, smooth : (J,) shape of the sign, see `Shapes`.
        """
        soft = smooth > 0
        z = np.empty(self.q.shape)
        if not soft.all():
            for a, b in self.thinning.segments:
                z[a:b] = presliding(np.ascontiguousarray(self.q[a:b]), delta, self.resolution)
        for i in np.flatnonzero(soft):
            z[:, i] = np.tanh(self.qd[:, i] / smooth[i])
        return z

    def bell(self, speed: np.ndarray) -> Bell:
        """Return the factor of Stribeck's column.

        Parameters
        ----------
        speed : (J,) v_s of Stribeck's term.
        """
        return Bell(self.qd, speed)

    def columns(self, s: np.ndarray, bells: Sequence[Bell | np.ndarray], signs: bool = True) -> np.ndarray:
        """Return the columns (M, J, 3 + S) of a sign: s+, s-, root, then Stribeck of each bell.

        Parameters
        ----------
        s : (N, J) from `sign`. bells : S from `bell`, or their arrays (N, J).
        signs : whether the first three are wanted.
        """

        def made(a: int, b: int) -> np.ndarray:
            z = s[a:b]
            own = [np.maximum(z, 0.0), np.minimum(z, 0.0), z * np.sqrt(np.abs(self.qd[a:b]))] if signs else []
            return np.concatenate([*own, *(z * bell[a:b] for bell in bells)], axis=1)

        J, count = self.q.shape[1], 3 * signs + len(bells)
        return np.moveaxis(self.thinning.run(made, J * count).reshape(-1, count, J), 1, 2)
