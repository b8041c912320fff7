"""Where the parameters of `fit_dynamics` stand: base, then each joint's own, then those of coupled motors."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from armlab.identify.base_parameters import BaseParameters
from armlab.robots import Robot

__all__ = ["Layout"]

BOUNDED = ("viscous", "coulomb", "coulomb+", "coulomb-", "rotor")  # not negative
COUPLED = ("rotor", "viscous", "coulomb")  # of a motor that moves several joints
SLOPES = ("delta", "tanh-speed", "stribeck-speed")  # numbers of the shape of friction


@dataclass(frozen=True, eq=False)
class Layout:
    """Names, units, bounds and places of p parameters.

    Attributes
    ----------
    robot, base : the arm and its base parameters. joints : (J,) those whose torque counts.
    motors : (K, n) angles theta = c q of motors that move several joints. owners : (K,) the joint each belongs to.
    terms : names of each joint's own parameters.
    """

    robot: Robot
    base: BaseParameters
    joints: np.ndarray
    motors: np.ndarray
    owners: np.ndarray
    terms: tuple[tuple[str, ...], ...]

    @property
    def columns(self) -> list[np.ndarray]:
        """Which parameters the columns of each joint belong to: base, own, coupled motors."""
        counts = [len(terms) for terms in self.terms]
        first = len(self.base.names) + np.concatenate([[0], np.cumsum(counts)])
        out = []
        for i, joint in enumerate(self.joints):
            moved = np.flatnonzero(self.motors[:, joint])
            coupled = first[-1] + (3 * moved[:, None] + np.arange(3)).ravel()
            out.append(np.concatenate([np.flatnonzero(self.base.seen[joint]), np.arange(*first[i : i + 2]), coupled]))
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: base, own of each joint, coupled motors."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            plain = {"offset": self.base.offset_names[i]}
            own += [plain.get(term, f"{term} {self.robot.joint_names[i]}") for term in terms]
        motors = [f"{term} of motor {self.robot.joint_names[i]}" for i in self.owners for term in COUPLED]
        return (*self.base.names, *own, *motors)

    @property
    def heads(self) -> list[str]:
        """Names without the combination that base parameters stand for, which fills a line."""
        return [re.split(r" [+-] ", name)[0] for name in self.names]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            force, length = ("N", "m") if self.robot.prismatic[i] else ("N m", "rad")
            special = {"viscous": f"{force} s/{length}", "root": f"{force} sqrt(s/{length})", "delta": length}
            special |= {"tanh-speed": f"{length}/s", "stribeck-speed": f"{length}/s"}
            own += [special.get(term, force) for term in terms]
        return (*self.base.units, *own, *("kg m^2", "N m s/rad", "N m") * len(self.motors))

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of all parameters: 0 for inertia, viscous and Coulomb friction, else -inf."""
        own = [term for terms in self.terms for term in terms] + list(COUPLED) * len(self.motors)
        return np.concatenate([self.base.lower, [0.0 if term in BOUNDED else -np.inf for term in own]])

    @property
    def slopes(self) -> np.ndarray:
        """Which parameters (p,) are steps of the logarithm of a number of the shape of friction."""
        own = [term in SLOPES for terms in self.terms for term in terms]
        return np.array([False] * len(self.base.names) + own + [False] * 3 * len(self.motors))
