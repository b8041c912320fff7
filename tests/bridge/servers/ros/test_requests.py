"""What ROS programs may send, and what is refused before the loop hears of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.messages import CommandRequest, SetRequest, Stop
from armlab.bridge.servers.ros.requests import Commands
from armlab.errors import CommandRefused

ARMS = {name: robots.load(name) for name in ("yumi_right", "yumi_left")}
COMMANDS = Commands("yumi", ARMS)
POSITION = "/yumi_left/joint_group_position_controller/command"
SEVEN = [0.1 * k for k in range(7)]


def _nested(depth: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(depth):
        found = [found]
    return found


@pytest.mark.parametrize(("kind", "field"), [("position", "q"), ("velocity", "qd"), ("effort", "tau")])
@pytest.mark.parametrize("spelling", ["command", "commands"])
def test_a_command_of_either_spelling_is_for_one_arm(kind: str, field: str, spelling: str) -> None:
    topic = f"/yumi_left/joint_group_{kind}_controller/{spelling}"
    assert COMMANDS.types[topic] == "std_msgs/msg/Float64MultiArray"
    (request,) = COMMANDS.requests(topic, SEVEN, "me")
    assert isinstance(request, CommandRequest)
    assert (request.client, request.arm, getattr(request, field)) == ("me", "yumi_left", SEVEN)
    assert sum(values is not None for values in (request.q, request.qd, request.tau)) == 1


def test_numbers_may_be_a_list_a_tuple_or_an_array() -> None:
    for content in (SEVEN, tuple(SEVEN), np.array(SEVEN)):
        (request,) = COMMANDS.requests(POSITION, content, "me")
        assert isinstance(request, CommandRequest)
        assert request.q == SEVEN


def test_fourteen_numbers_are_left_then_right() -> None:
    both = COMMANDS.requests("/yumi/joint_group_velocity_controller/commands", [*range(14)], "me")
    told = [(one.arm, one.qd, one.first) for one in both if isinstance(one, CommandRequest)]
    assert told == [("yumi_left", [0, 1, 2, 3, 4, 5, 6], 0), ("yumi_right", [7, 8, 9, 10, 11, 12, 13], 7)]


def test_a_cell_of_one_arm_has_no_topics_of_two() -> None:
    assert not any(name.startswith("/cell/") for name in Commands("cell", {"irb120": robots.load("irb120")}).types)


def test_settings_and_stops() -> None:
    (setting,) = COMMANDS.requests("/yumi_left/set_parameter", '{"gain": 2.0, "gentle": true}', "me")
    assert setting == SetRequest("me", {"gain": 2.0, "gentle": True})
    assert COMMANDS.requests("/yumi_right/stop", None, "me") == [Stop("me")]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (SEVEN[:6], "Expected 7 numbers .* got 6"),
        ([*SEVEN[:6], math.nan], "finite numbers .* got nan for yumi_robl_joint_7|finite numbers .* got nan"),
        ([*SEVEN[:6], None], "finite numbers"),
        ([*SEVEN[:6], "a"], "Expected 7 numbers"),
        ([*SEVEN[:6], 10**400], "Expected 7 numbers"),
        (None, "Expected 7 numbers"),
        (0.5, "Expected 7 numbers"),
        ([True] * 7, "Expected 7 numbers .* got .True"),
        (np.ones(7, bool), "Expected 7 numbers .* got .True"),
        (["0"] * 7, "Expected 7 numbers"),
        ("0000000", "Expected 7 numbers"),
        ({str(k): 0 for k in range(7)}, "Expected 7 numbers .* got ."),
        (np.ones((7, 1)), "Expected 7 numbers"),
        (_nested(900), "Expected 7 numbers"),
    ],
)
def test_one_bad_number_refuses_the_whole(content: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        COMMANDS.requests(POSITION, content, "me")


@pytest.mark.parametrize("content", ["", "gain", "[1]", "{}", None, 3, "[" * 3000, "x" * 70000])
def test_settings_that_are_none_are_refused(content: Any) -> None:
    with pytest.raises(CommandRefused, match="on /yumi_left/set_parameter"):
        COMMANDS.requests("/yumi_left/set_parameter", content, "me")


_JSON = st.recursive(st.none() | st.booleans() | st.floats() | st.text(), lambda inner: st.lists(inner), max_leaves=5)


@given(topic=st.sampled_from(sorted(COMMANDS.types)), content=_JSON)
def test_any_content_is_taken_or_refused_by_a_sentence(topic: str, content: Any) -> None:
    refused = ""
    try:
        found = COMMANDS.requests(topic, content, "me")
    except CommandRefused as error:
        found, refused = [], str(error)
    assert found or topic in refused
