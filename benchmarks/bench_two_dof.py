"""Motion controllers at 250 Hz: the two-degree-of-freedom law alone, and one call of each controller."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from blocks import Block, Contender, Table, agree, alternate, figures, loop, table
from plain import oracles

from armlab import State, motion, robots
from armlab.kinematics import forward
from armlab.motion.primitive.run import RunParameters

DT = 0.004
KERNEL_BAR, CALL_BAR = 1 / 100, 3.0  # relative to plain NumPy; to a 10 µs loop, for 99.9 % of the calls
LOOP = "a loop of Python for 10 µs"
ROBOT = robots.load("yumi_right")
SPEED = np.array([1.0, 1.0, 0.0])
QUANTILES = {"50 %": 0.5, "99 %": 0.99, "99.9 %": 0.999, "the longest": 1.0}
Movement = motion.Dmp | motion.TwoDofDmp | motion.PoseDmp


def run(quick: bool) -> list[Table]:
    """Measure a step of the law for 7 joints with 50 kernels, and calls of both controllers."""
    shown = motion.profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + 0.2, duration=2.0)
    t = np.linspace(0.0, 2.0, 501)
    dmp = motion.fit_dmp(t, shown.at(t)[0]).value
    two_dof = motion.TwoDofDmp(dmp, e0=0.02)
    law, plain = two_dof._law(RunParameters.of(dmp)), _plain(two_dof)
    states = [_state(dmp, share) for share in np.linspace(0.0, 1.0, 200)]
    at = states[70], DT, 1, SPEED, dmp.y0 + 0.05, np.zeros(7)
    worst = agree("law", law.follow(*at)[0], plain.follow(*at)[0], 1e-12)

    def step(side):
        return lambda state: side.follow(state, DT, 1, SPEED, dmp.y0, dmp.v0)

    laws = [
        Contender("armlab kernels.TwoDof.follow", loop(step(law), states), "armlab"),
        Contender("armlab's reference kernel", loop(step(plain), states[:20]), bar=KERNEL_BAR, note="plain NumPy"),
    ]
    text = f"One step for 7 joints and 50 kernels from Python; it agrees with the reference to {worst:.1g}."
    pose = motion.fit_pose_dmp(t, forward(ROBOT, shown.at(t)[0])).value
    movements = {"TwoDofDmp": two_dof, "Dmp": dmp, "PoseDmp": pose}
    return [
        table("Two degrees of freedom: the law", text, "µs", laws, 5 if quick else 50),
        *_calls(movements, 1000 if quick else 10_000, 2 if quick else 10),
    ]


def _calls(movements: dict[str, Movement], count: int, rounds: int) -> list[Table]:
    """Return one table per quantile of the calls in a round, which is a complete motion with perfect tracking."""
    calls = [
        Contender(f"armlab {name}.controller", _along(one.controller(ROBOT, duration=count * DT), count), "armlab")
        for name, one in movements.items()
    ]
    calls.append(Contender(LOOP, _looping(count), "limit"))
    samples = alternate(calls, rounds)
    text = f"{count} calls per round, wall-clock time."
    tables = []
    for name, quantile in QUANTILES.items():
        bar = CALL_BAR if quantile == 0.999 else None
        rows = [replace(call, bar=bar, over=LOOP if bar else "") if call.role == "armlab" else call for call in calls]
        reduced = [[np.array([np.quantile(block, quantile)]) for block in blocks] for blocks in samples]
        tables.append(Table(f"A call of a controller: {name}", text, "µs", figures(rows, reduced), rounds))
    return tables


def _along(controller: motion.Controller, count: int) -> Block:
    session = 0

    def block() -> np.ndarray:
        nonlocal session
        session += 1
        seconds = np.empty(count)
        q, qd = ROBOT.q_home, np.zeros(7)
        for k in range(count):
            state = State(k * DT, DT, q, qd, q, session=session)
            start = perf_counter()
            command = controller(state)
            seconds[k] = perf_counter() - start
            q, qd = command.q, command.qd
        return seconds

    return block


def _looping(count: int) -> Block:
    def block() -> np.ndarray:
        seconds = np.empty(count)
        for k in range(count):
            start = perf_counter()
            for _ in range(1100):
                pass
            seconds[k] = perf_counter() - start
        return seconds

    return block


def _plain(two_dof: motion.TwoDofDmp) -> oracles.TwoDof:
    dmp, gains = two_dof.dmp, np.array([two_dof.kp, two_dof.kv, two_dof.kc, two_dof.alpha_e, two_dof.e_max])
    shape = dmp.centres, dmp.widths, dmp.weights, dmp.alpha_z, dmp.alpha_z * dmp.beta_z
    primitive = oracles.Primitive(*shape, dmp.alpha_x, dmp.tau_d / dmp.duration, dmp.schedule)
    zone, unit = np.asarray(two_dof.e0), np.asarray(two_dof.e_scale)
    return oracles.TwoDof(primitive, dmp.tau_d, dmp.y0, dmp.g, np.ones(7), gains, zone, unit)


def _state(dmp: motion.Dmp, share: float) -> np.ndarray:
    x = np.exp(-dmp.alpha_x * share * dmp.duration / dmp.tau_d)
    return np.concatenate([dmp.y0, np.zeros(14), dmp.y0, np.zeros(7), [x, 0.0]])
