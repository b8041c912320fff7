"""A receive queue that is never empty."""

from __future__ import annotations

from armlab.wire.egm.types import StandingQueue


def test_one_sentence_per_second_that_the_queue_is_never_empty() -> None:
    queue = StandingQueue()
    depths = [3] * 99 + [0] + [5, 2] * 100 + [-1] + [1] * 100
    sentences = {cycle: text for cycle, depth in enumerate(depths) if (text := queue.after(depth, 0.01))}
    assert list(sentences) == [199, 400]
    assert sentences[199].startswith("2 messages have waited"), "the fewest of that second"
    assert sentences[199].endswith("20 ms late.")
    assert sentences[400].startswith("1 message has waited")
