"""Use an external sensor: each State holds the latest value (NaN if stale) and its age; the log holds all values."""

import itertools

import numpy as np

from armlab import Command, State, bridge, robots
from armlab.log import Column

COUNTS = {"fresh": 0, "held": 0, "too old": 0}
FRAME = itertools.count()


def read_tracker() -> dict[str, object] | None:
    """Simulate a 30 Hz camera that sees the tool for two thirds of each second."""
    k = next(FRAME)
    return {"p": [0.4, 0.0, 0.2 + 0.01 * np.sin(k / 30)]} if k % 30 < 20 else None


def controller(state: State) -> Command:
    """Rotate the flange according to the tracker value; return to the start while the value is stale (NaN)."""
    seen = state.sources["tracker"]
    COUNTS["too old" if seen.stale else "fresh" if seen.fresh else "held"] += 1
    q = state.q_start.copy()
    q[6] += 0.0 if seen.stale else 2.0 * (seen["p"][2] - 0.2)
    return Command(q)


def main() -> None:
    fields = {"p": Column((3,), unit="m", frame="base")}
    tracker = bridge.CallableSource("tracker", fields, read_tracker, period=1 / 30)
    with bridge.connect("sim://yumi_right", robots.load("yumi_right")) as link:
        run = link.run(controller, seconds=1.5, sources=[tracker])
    print("packets by tracker state:", COUNTS)
    print("maximum age in the log [s]:", np.nanmax(run.table["tracker.age"]).round(2))


if __name__ == "__main__":
    main()
