"""What goes between the loop and a server process besides rows: JSON texts, of which each is one message."""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np

from armlab.bridge.inputs.parameters import Parameters
from armlab.errors import LinkError

_LARGEST = 65536  # bytes of a request


_Joints = Annotated[list[float | None], msgspec.Meta(max_length=64)]  # more would only cost the loop time


class _Message(msgspec.Struct, frozen=True, tag_field="kind", forbid_unknown_fields=True):
    """One request; `client` is whatever tells the connections of a server apart."""

    client: str = ""


class CommandRequest(_Message, tag="command", frozen=True):
    """References for one arm; see `order.Order`. A number that is not finite stands as null."""

    arm: str = ""
    q: _Joints | None = None
    qd: _Joints | None = None
    tau: _Joints | None = None
    seq: int | None = None
    first: int | None = None
    by_axis: bool = False


class SetRequest(_Message, tag="set", frozen=True):
    """Values of parameters by name, in force together or not at all."""

    values: dict[str, Any] = {}


class Stop(_Message, tag="stop", frozen=True):
    """All arms hold until an operator resumes."""


class Resume(_Message, tag="resume", frozen=True):
    """The operator ends a stop."""


class Release(_Message, tag="release", frozen=True):
    """The client's own arms are free; the operator's request frees all."""


class Leave(_Message, tag="leave", frozen=True):
    """The client has gone."""


class Listening(_Message, tag="listening", frozen=True):
    """The server is ready; where it listens, in words."""

    where: list[str] = []


class Report(_Message, tag="report", frozen=True):
    """What a client sent was no request, or it was closed: why, for the events of the run."""

    text: str = ""


class Counted(_Message, tag="counted", frozen=True):
    """What the server's clients got so far, asked for by the message "count": rows sent and dropped, by client."""

    clients: dict[str, tuple[int, int]] = {}


class Subscribe(_Message, tag="subscribe", frozen=True):
    """A client of the local feed wants this many rows a second, 0 for none; None for every row."""

    rate: float | None = 30.0


Request = CommandRequest | SetRequest | Stop | Resume | Release | Leave | Report | Listening | Counted | Subscribe
"""What a server process or a client of the local feed may ask for."""

_DECODER = msgspec.json.Decoder(Request)


def read_request(data: bytes) -> Request:
    """Return the request in `data`."""
    if len(data) > _LARGEST:
        raise LinkError(f"Expected a request of at most {_LARGEST} bytes, got {len(data)}. Send less at once.")
    try:
        return _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(f"Expected a request in JSON, but {str(error).rstrip('.')}.") from None


def text_message(kind: str, **fields: Any) -> bytes:
    """Return a message of the loop as JSON."""
    return msgspec.json.encode({"kind": kind, **fields}, enc_hook=_plain)


def parameter_message(parameters: Parameters) -> bytes:
    """Return all declarations and values in force, and the last who set each, as one message."""
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
