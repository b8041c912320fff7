"""Two-degree-of-freedom control at 250 Hz: the compiled law alone, and one call of the controller."""

from __future__ import annotations

import numpy as np
from blocks import Contender, Table, agree, each, loop, table

from armlab import State, motion, robots
from armlab.kernels import _reference
from armlab.motion._setting import Setting

DT = 0.004
KERNEL_BAR, CALL_BAR = 3e-6, 30e-6  # s; the second for 99.9 % of the calls
ROBOT = robots.load("yumi_right")
SPEED = np.array([1.0, 1.0, 0.0])


def run(quick: bool) -> list[Table]:
    """Measure a step of the law of 7 joints with 50 kernels, and calls of both controllers."""
    shown = motion.profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + 0.2, duration=2.0)
    t = np.linspace(0.0, 2.0, 501)
    dmp = motion.fit_dmp(t, shown.at(t)[0]).value
    two_dof = motion.TwoDofDmp(dmp, e0=0.02)
    law, plain = two_dof.law(Setting.of(dmp)), _plain(two_dof)
    states = [_state(dmp, share) for share in np.linspace(0.0, 1.0, 200)]
    at = states[70], DT, 1, SPEED, dmp.y0 + 0.05, np.zeros(7)
    worst = agree("law", law.follow(*at)[0], plain.follow(*at)[0], 1e-12)

    def step(side):
        return lambda state: side.follow(state, DT, 1, SPEED, dmp.y0, dmp.v0)

    laws = [
        Contender("armlab kernels.TwoDof.follow", loop(step(law), states), "armlab", KERNEL_BAR),
        Contender("armlab's reference kernel", loop(step(plain), states[:20]), note="plain NumPy"),
    ]
    count = 1000 if quick else 5000
    calls = [
        Contender(f"armlab {name}.controller, 99.9 %", _slowest(_calls(one, count)), "armlab", CALL_BAR)
        for name, one in (("TwoDofDmp", two_dof), ("Dmp", dmp))
    ]
    text = f"One step of 7 joints and 50 kernels from Python; agreement with the reference to {worst:.1g}."
    return [
        table("Two degrees of freedom: the law", text, "µs", laws, 5 if quick else 50),
        table(
            "Two degrees of freedom: a call", "The 99.9 % quantile of calls in a row.", "µs", calls, 2 if quick else 10
        ),
    ]


def _plain(two_dof: motion.TwoDofDmp) -> _reference.TwoDof:
    dmp, gains = two_dof.dmp, np.array([two_dof.kp, two_dof.kv, two_dof.kc, two_dof.alpha_e, two_dof.e_max])
    shape = dmp.centres, dmp.widths, dmp.weights, dmp.alpha_z, dmp.alpha_z * dmp.beta_z
    primitive = _reference.Primitive(*shape, dmp.alpha_x, dmp.tau_d / dmp.duration, dmp.schedule)
    zone, unit = np.asarray(two_dof.e0), np.asarray(two_dof.e_scale)
    return _reference.TwoDof(primitive, dmp.tau_d, dmp.y0, dmp.g, np.ones(7), gains, zone, unit)


def _state(dmp: motion.Dmp, share: float) -> np.ndarray:
    x = np.exp(-dmp.alpha_x * share * dmp.duration / dmp.tau_d)
    return np.concatenate([dmp.y0, np.zeros(14), dmp.y0, np.zeros(7), [x, 0.0]])


def _calls(what: motion.Dmp | motion.TwoDofDmp, count: int):
    """Return a block of single calls of one controller along its motion and after it."""
    controller, q = what.controller(ROBOT), ROBOT.q_home
    states = [State(k * DT, DT, q, np.zeros(7), q) for k in range(count)]
    return each(controller, states)


def _slowest(block):
    return lambda: np.array([np.quantile(block(), 0.999)])
