"""`Scene`: what happens around a simulated controller: who pushes or leads the arm, who switches motors and RAPID."""

from __future__ import annotations

from dataclasses import dataclass, field

from armlab.errors import ShapeError
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
    motors, rapid : their states over robot time. external : number of external axes.
    """

    operator: Operator = field(default_factory=Operator.idle)
    hand: HandPath | None = None
    motors: Script = field(default_factory=lambda: Script("on", MOTORS))
    rapid: Script = field(default_factory=lambda: Script("running", RAPID))
    external: int = 0

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
