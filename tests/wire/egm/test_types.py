"""Types of the EGM codec, and a receive queue that a robot does not empty."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.wire.egm import EgmCodec
from armlab.wire.egm.types import (
    DROP_REASONS,
    Beside,
    Codec,
    Drop,
    Packet,
    Reference,
    RobotAxes,
    RobotMessage,
    SensorMessage,
    StandingQueue,
)


def test_a_robot_is_an_arm_and_the_codec_is_a_codec() -> None:
    arm: RobotAxes = robots.load("yumi_right")
    codec: Codec = EgmCodec(arm)
    assert codec.capabilities == {"position", "velocity", "external_axes", "rapid_data"}
    assert arm.abb_axes == (1, 2, 7, 3, 4, 5, 6)


@pytest.mark.parametrize(
    "value",
    [
        Drop("old", "packet 3 after 5"),
        Reference(np.zeros(1), None, None, 0, 0),
        Beside(rapid_digital=True),
        RobotMessage(0, 0, np.zeros(1)),
        SensorMessage(0, None, 3),
    ],
)
def test_values_cannot_be_changed(value: tuple[object, ...]) -> None:
    with pytest.raises(AttributeError):
        value.seqno = 1  # type: ignore[attr-defined]


def test_reasons_are_words_of_a_fixed_set() -> None:
    assert len(set(DROP_REASONS)) == len(DROP_REASONS)
    assert {"unparsable", "no header", "foreign source", "duplicate", "old"} <= set(DROP_REASONS)
    assert Packet._fields[:2] == ("seqno", "tm_ms")


def test_one_sentence_per_second_that_the_queue_is_never_empty() -> None:
    queue = StandingQueue()
    depths = [3] * 99 + [0] + [5, 2] * 100 + [-1] + [1] * 100
    sentences = {cycle: text for cycle, depth in enumerate(depths) if (text := queue.after(depth, 0.01))}
    assert list(sentences) == [199, 400]
    assert sentences[199].startswith("2 messages have waited"), "the fewest of that second"
    assert sentences[199].endswith("20 ms late.")
    assert sentences[400].startswith("1 message has waited")
