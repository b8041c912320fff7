"""JSON messages between the loop and a server process (everything except rows)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Annotated, Any

import msgspec
import numpy as np

from armlab.bridge.control.limits import Limits
from armlab.bridge.inputs.parameters import Parameters
from armlab.errors import LinkError
from armlab.robots import Robot

_LARGEST = 65536  # maximum size of a request in bytes


_Joints = Annotated[list[float | None], msgspec.Meta(max_length=64)]  # bounds the loop's work


class _Message(msgspec.Struct, frozen=True, tag_field="kind", forbid_unknown_fields=True):
    """Base class of requests; `client` identifies the connection within its server."""

    client: str = ""


class CommandRequest(_Message, tag="command", frozen=True):
    """References for one arm; see `arbiter.Order`. Non-finite numbers become null."""

    arm: str = ""
    q: _Joints | None = None
    qd: _Joints | None = None
    tau: _Joints | None = None
    seq: int | None = None
    first: int | None = None
    by_axis: bool = False


class TrajectoryRequest(_Message, tag="trajectory", frozen=True):
    """Part `index` of `count` of a trajectory for one arm; the trajectory starts when the last part arrives."""

    arm: str = ""
    goal: str = ""
    points: bytes = b""  # rows of float64: time, positions and, if given, velocities and accelerations
    orders: Annotated[int, msgspec.Meta(ge=1, le=3)] = 1  # 1: positions only, 3: up to accelerations
    index: int = 0
    count: int = 1
    tolerances: bytes = b""  # four rows of float64: positions and velocities of the path, then of the goal
    goal_time: float = 0.0  # s
    begin: float = 0.0  # start time [s]


class Renew(_Message, tag="renew", frozen=True):
    """Renew the lease of a running trajectory while its client is connected."""

    arm: str = ""
    goal: str = ""


class Cancel(_Message, tag="cancel", frozen=True):
    """Bring the arm of a running goal to rest; any client may send this request, just like a stop request."""

    arm: str = ""
    goal: str = ""


class SetRequest(_Message, tag="set", frozen=True):
    """Parameter values by name; either all are applied or all are refused."""

    values: dict[str, Any] = {}


class Stop(_Message, tag="stop", frozen=True):
    """Hold all arms until an operator resumes."""


class Resume(_Message, tag="resume", frozen=True):
    """End a stop; for operators only."""


class Release(_Message, tag="release", frozen=True):
    """Release control of the client's arms or, if an operator sends the request, of all arms."""


class Leave(_Message, tag="leave", frozen=True):
    """Report that the client has disconnected."""


class Listening(_Message, tag="listening", frozen=True):
    """Report that the server is ready, with its addresses."""

    where: list[str] = []


class Report(_Message, tag="report", frozen=True):
    """Report an invalid message or a closed connection as an event of the run."""

    text: str = ""


class Counted(_Message, tag="counted", frozen=True):
    """Reply to the message "count": rows sent and dropped so far, by client."""

    clients: dict[str, tuple[int, int]] = {}


class Subscribe(_Message, tag="subscribe", frozen=True):
    """Subscribe a client of the local feed to rows at a rate [rows/s]; 0: no rows, None: every row."""

    rate: float | None = 30.0


Request = (
    CommandRequest
    | TrajectoryRequest
    | Renew
    | Cancel
    | SetRequest
    | Stop
    | Resume
    | Release
    | Leave
    | Report
    | Listening
    | Counted
    | Subscribe
)
"""All requests from a server process or a client of the local feed."""

_DECODER = msgspec.json.Decoder(Request)


def read_request(data: bytes) -> Request:
    """Decode a request; raise an error if it is invalid or too large."""
    if len(data) > _LARGEST:
        raise LinkError(f"Expected a request of at most {_LARGEST} bytes, got {len(data)}. Send a smaller request.")
    try:
        return _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(f"Expected a request in JSON, got {str(error).rstrip('.')}.") from None


def text_message(kind: str, **fields: Any) -> bytes:
    """Encode a message from the loop as JSON."""
    return msgspec.json.encode({"kind": kind, **fields}, enc_hook=_plain)


def parameter_message(parameters: Parameters) -> bytes:
    """Return a message with the declaration and current value of each parameter, and the client that last set it."""
    about = []
    for name, value in parameters.values().items():
        declared = parameters.declared[name]
        change = parameters.last(name)
        who, sequence = ("", 0) if change is None else (change.who, change.sequence)
        about.append(
            {
                "name": name,
                "value": value,
                "type": declared.type,
                "unit": declared.unit,
                "minimum": declared.minimum if math.isfinite(declared.minimum) else None,
                "maximum": declared.maximum if math.isfinite(declared.maximum) else None,
                "default": declared.default,
                "text": declared.text,
                "rights": declared.rights,
                "live": declared.live,
                "who": who,
                "sequence": sequence,
            }
        )
    return text_message("parameters", parameters=about)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


def limits_of_cell(robots: Iterable[Robot], about: Mapping[str, Any]) -> dict[str, Limits]:
    """Return the limits of each arm, with the speed limits of the cell from `about`."""
    speeds = about.get("speeds", {})
    return {one.name: replace(Limits.of(one), qd_max=np.array(speeds.get(one.name, one.qd_max))) for one in robots}
