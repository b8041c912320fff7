"""`Scene`: what happens around a simulated controller: who pushes, holds or leads the arm, who switches it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armlab.errors import ShapeError
from armlab.sim.grip import Grip
from armlab.sim.hand import HandPath
from armlab.sim.operator import Operator
from armlab.sim.script import MOTORS, RAPID, Script

__all__ = ["Scene"]

_ON, _STOPPED = MOTORS["on"], RAPID["stopped"]


@dataclass(frozen=True)
class Scene:
    """What happens around the controller.

    Attributes
    ----------
    operator : who pushes the arm, over guidance time. hand : who leads it in the program "lead-through".
    motors, rapid : their states over robot time. external : number of external axes. grip : who holds the tool.
    """

    operator: Operator = field(default_factory=Operator.idle)
    hand: HandPath | None = None
    motors: Script = field(default_factory=lambda: Script("on", MOTORS))
    rapid: Script = field(default_factory=lambda: Script("running", RAPID))
    external: int = 0
    grip: Grip | None = None

    def wrench(self, t: float, T_base_tool: np.ndarray) -> np.ndarray | None:
        """Return what hands exert on the tool, (6,) in base axes at the tool point; None while nobody touches it.

        Parameters
        ----------
        t : guidance time [s]. T_base_tool : (4, 4) pose of the tool.
        """
        pushed = self.operator.at(t)
        held = None if self.grip is None else self.grip.at(t, T_base_tool)
        if pushed is None or held is None:
            return held if pushed is None else pushed
        return pushed + held

    def leads(self, program: str, n: int) -> HandPath | None:
        """Return the hand that leads the arm in a program, None where nobody does.

        Parameters
        ----------
        program : see `guidance.Settings`. n : number of joints.

        Raises
        ------
        ShapeError : a hand for another number of joints.
        """
        hand = self.hand if program == "lead-through" else None
        if hand is not None and hand.n != n:
            raise ShapeError(f"Expected a hand path of {n} joints, got one of {hand.n}.")
        return hand

    def is_ready(self, t: float) -> bool:
        """Return whether motors and RAPID let guidance run. RAPID that is stuck at UNDEFINED does.

        Parameters
        ----------
        t : robot time [s].
        """
        return self.motors.at(t) == _ON and self.rapid.at(t) != _STOPPED
