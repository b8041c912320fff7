"""`PacketBuilder`: the packet of one motion task in each cycle, with the fields that were asked for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from armlab.errors import UnknownName
from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.controller.guidance import Guidance, ReferenceDecoder
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

EPOCH_NS = 1_500_000_000_000_000_000
"""Robot time starts here: the same bytes in every run."""

OPTIONAL_FIELDS = {
    "tm": "tm_ms",
    "planned": "q_planned",
    "cartesian": "T_frame_tool",
    "time": "robot_ns",
    "motorState": "motors",
    "mciState": "mci",
    "rapidExecState": "rapid",
    "mciConvergenceMet": "converged",
    "utilizationRate": "utilization",
}
"""Fields of EgmRobot that can be left out, by their names on the wire."""

_UPTIME_MS = 10_000  # tm of the first packet; 0 would look like "no tm" when it is echoed


class PacketBuilder:
    """Builds EgmRobot messages, `phase` seconds behind the robot's clock.

    Of RobotWare 7: `torque_reference` sends the torque of the drives as torqueRef; `data` is how many of the numbers
    that RAPID hears it sends back, with the digital value.
    """

    def __init__(
        self,
        codec: RobotSideCodec,
        period: float,
        *,
        fields: Iterable[str] = (),
        phase: float = 0.0,
        force: bool = False,
        torque_reference: bool = False,
        data: int = 0,
    ) -> None:
        self.codec, self._period, self._phase = codec, period, phase
        self._force, self._torque_reference, self._data = force, torque_reference, data
        self._left_out: dict[str, Any] = {}
        for field in fields:
            if field not in OPTIONAL_FIELDS:
                raise UnknownName.among("field of EgmRobot that can be left out", field, OPTIONAL_FIELDS)
            self._left_out[OPTIONAL_FIELDS[field]] = None

    def time_ns(self, cycle: int) -> int:
        """Return the robot's clock in a cycle [ns]: exact multiples of the period, behind by the phase."""
        return EPOCH_NS + round((cycle * self._period + self._phase) * 1e9)

    def tm_ms(self, cycle: int) -> int:
        """Return the `tm` of a cycle's packet: whole milliseconds, so packets of shorter periods share it."""
        return _UPTIME_MS + int((cycle * self._period + self._phase) * 1e3 + 1e-6)

    def encode(
        self,
        cycle: int,
        arm: SimulatedArm | LaggingArm,
        guidance: Guidance,
        q_ext: Sequence[float] = (),
        target: ReferenceDecoder | None = None,
        **condition: Any,
    ) -> bytes:
        """Return the bytes of a cycle's packet, RAPID's echo of `target` and other fields of `condition` included."""
        measured, sample = arm.measure(), arm.sample
        feels = arm.has_torque
        heard = target if self._data else None
        message = RobotMessage(
            tm_ms=self.tm_ms(cycle),
            q=measured.q,
            q_planned=guidance.q,
            robot_ns=self.time_ns(cycle),
            q_ext=q_ext,
            T_frame_tool=arm.robot.chain.forward(measured.q),
            utilization=guidance.utilization,
            wrench_raw=np.array(sample.wrench) if self._force else None,
            rapid_data=heard.rapid_data[: self._data].tolist() if heard else (),
            rapid_digital=heard.rapid_digital if heard else None,
            tau_reference=sample.tau if self._torque_reference and feels else None,
            qd=measured.qd,
            tau=measured.tau if feels else None,
            tau_total=sample.tau if feels else None,
            tau_gravity=sample.tau_gravity if feels else None,
            q_reference=guidance.q,
            qd_reference=guidance.qd,
            mono_ns=self.time_ns(cycle) - EPOCH_NS,
            **condition,
        )
        return self.codec.encode_robot(message._replace(**self._left_out) if self._left_out else message)
