"""What bridges say in JSON over Zenoh, checked before anybody uses it: `read_about`, `read_message`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import msgspec

from armlab.bridge.servers.row import RowSchema
from armlab.errors import LinkError
from armlab.robots import Robot, from_toml

__all__ = ["About", "read_about", "read_message"]

_LARGEST = 2**17  # bytes of a message of the loop, of which a bridge passes on three at most
_Count = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class _About(msgspec.Struct, tag_field="kind", tag="about"):
    schema: str
    robots: dict[str, str]
    run: str = ""
    cell: str = ""


class _Parameters(msgspec.Struct, tag_field="kind", tag="parameters"):
    parameters: list[dict[str, Any]]


class _Recording(msgspec.Struct, tag_field="kind", tag="recording"):
    files: list[str]


class _Event(msgspec.Struct, tag_field="kind", tag="event"):
    stamp_ns: _Count
    text: str


class _ArmStatus(msgspec.Struct):
    rate: float | None = None
    p50: float | None = None
    p99: float | None = None
    longest: float | None = None
    missed: _Count = 0
    late: _Count = 0
    drops: _Count = 0
    clamps: dict[str, list[_Count]] = {}


class _Status(msgspec.Struct, tag_field="kind", tag="status"):
    arms: dict[str, _ArmStatus]
    lost: _Count = 0


_Text = _Parameters | _Recording | _Event | _Status


class About(NamedTuple):
    """What a bridge says of itself."""

    said: list[dict[str, Any]]
    schema: RowSchema
    robots: Mapping[str, Robot]
    run: str
    cell: str


def read_about(data: bytes) -> About:
    """Return what a bridge answers to the query "about"."""
    said = _converted(_decoded(data, 3 * _LARGEST), list[dict[str, Any]])
    about = _converted(said[0] if said else {}, _About)
    for one in said[1:]:
        _converted(one, _Text)
    schema = RowSchema.read(about.schema.encode())
    if set(about.robots) != set(schema.robots):
        raise LinkError(
            f"Expected a bridge that describes the arms of its rows, {', '.join(schema.robots)[:200]}, got "
            f"{', '.join(about.robots)[:200] or 'none'}. Install the same armlab at both ends."
        )
    robots = {name: replace(from_toml(text, f"the bridge of {name}"), name=name) for name, text in about.robots.items()}
    for robot in robots.values():
        schema.require(robot, whole=False)
    for field in schema.fields.values():  # a text is the name of an arm's commander: by that a `Watch` knows the arms
        if field.type == "text" and field.name.removesuffix(".commander") not in robots:
            raise LinkError(f"Expected rows in which only commanders of arms are texts, got {field.name[:60]}.")
    return About([{**said[0], "kind": "about"}, *said[1:]], schema, robots, about.run, about.cell)


def read_message(data: bytes) -> dict[str, Any]:
    """Return a text of the keys "events", "status" and "parameters", as `LocalFeed.receive` gives it."""
    message = _decoded(data, _LARGEST)
    _converted(message, _Text)
    return message


def _decoded(data: bytes, largest: int) -> Any:
    if len(data) > largest:
        raise LinkError(f"Expected a text of a bridge of at most {largest} bytes, got {len(data)}. Send less at once.")
    try:
        return msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(f"Expected a text of a bridge in JSON, but {str(error).rstrip('.')}.") from None


def _converted(value: Any, type: Any) -> Any:
    try:
        return msgspec.convert(value, type)
    except msgspec.ValidationError as error:
        raise LinkError(f"Expected a text of a bridge, but {str(error)[:200].rstrip('.')}.") from None
