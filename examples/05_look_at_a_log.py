"""Read a recording, select rows and columns, derive a new column and plot it.

Run 02_move_a_simulated_arm.py first; it writes sine.mcap.
"""

import numpy as np

from armlab import log, plots, signals
from armlab.log import Column, Table


def main() -> None:
    table = log.read("sine.mcap")
    print(table["q"].shape, table.units["q"], "joints", table.columns["q"].labels)

    moving = table.between(1.0, 5.0).select("q", "qd", "q_sent")  # half-open interval in seconds; returns a view
    print(moving.describe())

    error = table["q_sent"] - table["q"]  # missing values stay NaN
    table = table.with_column("tracking_error", error, unit="rad")
    worst = np.nanargmax(np.abs(error[:, -1]))
    print(f"largest tracking error {np.rad2deg(error[worst, -1]):.2f} deg at t = {table.t[worst]:.2f} s")

    slope = signals.central_diff(table["q"], table.t)  # uses the actual time stamps
    print("measured velocity minus position derivative, sd [rad/s]:", np.std(table["qd"] - slope, axis=0).round(5))

    figure = plots.table(table, "q", "q_sent", "tau", "tracking_error")
    figure.savefig("sine.png", dpi=120)
    print("figure: sine.png")

    mine = Table(table.t, {"q": table["q"], "grip": np.sin(table.t)}, {"grip": Column(unit="N")})
    print(mine.resample(500.0))


if __name__ == "__main__":
    main()
