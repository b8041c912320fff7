"""Integrate, differentiate and filter in a control loop, using the measured time step."""

import numpy as np

from armlab import signals


def main() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.003, 0.005, 500))  # about 250 Hz, with jitter
    force = 5.0 * (t > 1.0) + 0.2 * rng.standard_normal(500)  # a hand pushes after 1 s

    smooth = signals.ExpFilter(time_constant=0.05)  # @expfilt force 0.92
    position = signals.Integrator(dt=0.004)  # @integrate velocity 0
    velocity_of = signals.CausalDiff(cutoff=10.0)  # @differentiate position, filtered
    for k in range(500):  # control loop
        filtered = smooth.step(force[k], t[k])
        q = position.step(0.02 * filtered, t[k])  # admittance: 20 mm/s per newton
        qd = velocity_of.step(q, t[k])
    print(f"moved {1e3 * q:.1f} mm, moving at {1e3 * qd:.1f} mm/s under {filtered:.2f} N")
    print(f"steps longer than 1.5 dt: {position.gaps}, non-finite samples: {position.skipped}")

    smooth.reset()
    record = smooth.run(force, t)  # the same filter offline: bit-identical to the loop
    print("same final value as in the loop:", bool(record[-1] == filtered))

    twin = signals.filtfilt(smooth, force, t)  # forward and backward: no delay, offline only
    rises = [t[np.argmax(x > 2.5)] for x in (record, twin)]
    print(f"half of the step is reached at {rises[0]:.3f} s (causal), {rises[1]:.3f} s (zero phase)")

    even = np.arange(0.0, 1.8, 0.004)
    slope = signals.smooth_diff(np.sin(2 * np.pi * even) + 1e-3 * rng.standard_normal(450), even, bandwidth=10.0)
    error = slope - 2 * np.pi * np.cos(2 * np.pi * even)
    print(f"smooth derivative of a noisy sine: error {np.std(error):.3f} rad/s, amplitude {2 * np.pi:.2f} rad/s")


if __name__ == "__main__":
    main()
