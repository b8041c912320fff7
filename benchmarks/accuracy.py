"""Accuracy of the estimated contact force over many seeds; --publish writes docs/accuracy.md.

python benchmarks/accuracy.py                 20 seeds, about 30 s each
python benchmarks/accuracy.py --seeds 3       quick look
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import force_protocol as protocol
import numpy as np
from force_protocol import SPEEDS, Score

METHODS = ("map", "bounded", "observer", "kf")
GAINS = 0.05
WHAT = f"""\
# Accuracy of the estimated force

This page reports the contact force error and interval coverage of each estimator method, in simulation and on real
arms. This page also compares parameters fitted to the two halves of a log.

`python benchmarks/accuracy.py` runs the test protocol with {{count}} seeds on a simulated YuMi arm (`{{robot}}`). For
each seed, a model is identified from 60 s of excitation and then tested on a second log. The test log contains 60 s of
a different motion with 5 N pushes in random directions, two 500 g presses during a dither, and the same two presses at
rest. Motions, noise and pushes differ between seeds. The estimator has access only to the logs. In the tests with
unknown gains, every torque sensor has a gain error of up to {100 * GAINS:.0f} %.

Each cell gives the median over all seeds, with the minimum and maximum in parentheses. Errors are those of the worst
axis; coverage is computed over all axes. Targets apply to every seed: if the minimum or
maximum lies outside the target range, at least one seed misses the target. *Edges* are the first {protocol.EDGE:g} s of
each ramp.
"""
BARS: tuple[tuple[str, str, str, Callable[[Score], object]], ...] = (
    ("force error during pushes, RMS, worst axis [N]", "1.0", "1.5", lambda s: s.rms.max()),
    ("false force in free motion, RMS, worst axis [N]", "1.0", "", lambda s: s.free.max()),
    ("within 2 sigma, without edges [%]", "90 to 97", "at least 85", lambda s: 100 * s.inside),
    ("within 2 sigma, all rows [%]", "at least 88", "", lambda s: 100 * s.with_edges),
    ("500 g during a dither, mean of 2 s, error [%]", "within 10", "", lambda s: [100 * v for v in s.press.values()]),
    ("at rest: truth inside the band [%]", "100", "", lambda s: 100 * s.rest_inside),
    ("at rest: rows flagged stuck [%]", "", "", lambda s: 100 * s.stuck),
)


def main() -> int:
    """Run all seeds and print the tables."""
    parser = argparse.ArgumentParser(description="Accuracy of the estimated contact force.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--robot", default="yumi_left")
    parser.add_argument("--publish", action="store_true", help="also write docs/accuracy.md")
    options = parser.parse_args()
    text = [WHAT.format(count=options.seeds, robot=options.robot)]
    for title, gains in (("Nominal gains", 0.0), ("Unknown gains", GAINS)):
        scores: dict[str, list[Score]] = {method: [] for method in METHODS}
        for seed in range(options.seeds):
            print(f"{title}, seed {seed} ...", file=sys.stderr, flush=True)
            logs = protocol.record(options.robot, seed, gains)
            for method in METHODS:
                scores[method].append(protocol.judge(logs, method))
        text += [f"## {title}", "", *_bars(scores, gains > 0), "", *_speeds(scores), ""]
    page = "\n".join(text)
    print(page)
    if options.publish:
        path = Path(__file__).resolve().parents[1] / "docs" / "accuracy.md"
        _, title, kept = path.read_text(encoding="utf-8").partition("\n## Parameter consistency")
        path.write_text(page + title + kept, encoding="utf-8")
    return 0


def _bars(scores: dict[str, list[Score]], gains: bool) -> list[str]:
    lines = [f"| | target | {' | '.join(scores)} |", "|---|---|" + "---|" * len(scores)]
    for name, bar, bar_with_gains, read in BARS:
        cells = [_spread([read(score) for score in found]) for found in scores.values()]
        lines.append(f"| {name} | {bar_with_gains if gains else bar} | {' | '.join(cells)} |")
    return lines


def _speeds(scores: dict[str, list[Score]]) -> list[str]:
    """Return the table of coverage by speed: the share of forces within 2 sigma [%]."""
    edges = [f"{100 * a:g} to {100 * b:g} %" for a, b in pairwise(SPEEDS)]
    lines = [f"| within 2 sigma [%], speed of the fastest joint | {' | '.join(edges)} |", "|---|" + "---|" * len(edges)]
    for method, found in scores.items():
        cells = [_spread([100 * score.by_speed[k] for score in found]) for k in range(len(edges))]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines


def _spread(values: Sequence[object]) -> str:
    """Return the median (minimum to maximum) of the finite values."""
    numbers = np.concatenate([np.ravel(np.asarray(value, dtype=float)) for value in values])
    numbers = numbers[np.isfinite(numbers)]
    if not len(numbers):
        return "–"
    middle, least, largest = np.median(numbers), numbers.min(), numbers.max()
    return f"{middle:.3g} ({least:.3g} to {largest:.3g})"


if __name__ == "__main__":
    sys.exit(main())
