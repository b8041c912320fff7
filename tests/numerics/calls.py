"""How the kernels are called with the inputs of a table, topic by topic."""

from __future__ import annotations

from typing import Any

import numpy as np

METHODS = ("map", "bounded", "clip", "interval", "ls", "lund", "ols")  # by their numbers


def of_group(module: Any, name: str, given: dict[str, np.ndarray], _: dict[str, np.ndarray]) -> Any:
    name, chosen = (*name.split(), "")[:2]
    given = given | ({"s": given["s"][:, 0]} if "s" in given else {})
    more: dict[str, Any] = {"screw": True} if chosen == "screw" else {}
    if name.startswith("euler"):
        more = {axis: "xyz".index(letter) for axis, letter in zip(("first", "middle", "last"), chosen)}
    return getattr(module, name)(*given.values(), **more)


def of_chain(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    chain, words = module.Chain(fixed["frames"], fixed["prismatic"]), name.split()
    if words[0] in ("mass_matrix", "momentum"):
        chain, given = module.RigidBody(chain, np.zeros(3), given["pi"]), {k: x for k, x in given.items() if k != "pi"}
    found = getattr(chain, words[0])(**given, **({"tool": True} if "tool" in words else {}))
    return np.stack(found, axis=-2) if words[0] == "momentum" else found


def of_filter(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    words, values = name.split(), list(given.values())
    match words[0]:
        case "SignalOperator":
            return module.SignalOperator(words[1], *given["constants"].tolist()).run(given["x"])
        case "Drive":
            return module.Drive(_and_zeros(values[0]), values[1]).torque(*values[2:])
        case "basis" | "rollout":
            primitive = primitive_of(module, words[1], fixed)
            if words[0] == "basis":
                return primitive.basis(given["x"])
            return primitive.rollout(given["t"], float(given["tau"]), *given["ends"])[
                ("y", "yd", "ydd").index(words[2])
            ]
        case "momentum_step":
            found = module.momentum_step(*values[:6], float(given["h"][0]), *values[7:])
            return found[1][:2, :2] if words[1] == "wandered" else found[int(words[1])]
    return getattr(module, name)(*values)


def of_limits(module: Any, _: str, given: dict[str, np.ndarray], __: dict[str, np.ndarray]) -> Any:
    rows = []
    for sent, bounds, period, asked in zip(*given.values()):
        wanted = (None if np.isnan(row).all() else row for row in asked)
        state, bits, ratio, refused = module.limit_reference(sent, bounds, float(period[0]), *wanted)
        rows += [*state, bits, (ratio, refused, 0.0)]
    return np.array(rows, dtype=float)


def of_primitive(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    words, outputs = name.split(), ("y", "yd", "ydd")
    primitive = primitive_of(module, words[1], fixed)
    match words[0]:
        case "rollout":
            return primitive.rollout(given["t"], float(given["tau"]), *given["ends"])[outputs.index(words[2])]
        case "response":
            return np.concatenate(primitive.response(given["t"], float(given["tau"]), float(given["longest"])), axis=-1)
        case "forcing":
            return primitive.forcing(given["phase"])
    return controlled(module.TwoDof(primitive, *fixed_of_control(fixed)), words[2], **given)


def of_orientation(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    """Return the results of a run, or of each step when goal, map and time constant change before the fourth step."""
    call, kind, output = name.split()
    primitive, k = primitive_of(module, kind, fixed), ("q", "w", "wd").index(output)
    begin = given["q0"], given["w0"], given["goals"][0], given["turns"][0]
    if call == "rotation_rollout":
        return module.rotation_rollout(primitive, given["t"], float(given["taus"][0]), *begin)[k]
    stepper = module.RotationStepper(primitive)
    stepper.start(*begin, float(given["taus"][0]))
    rows = [stepper.outputs()[k]]
    for step, dt in enumerate(given["dt"].tolist()):
        if step == 3:
            stepper.change_goal(given["goals"][1], given["turns"][1])
            stepper.change_tau(float(given["taus"][1]))
        rows.append(stepper.step(dt)[k])
    return np.array(rows)


def of_stepper(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    """Return the results of each step of a run whose goal, scale and time constant change before the fourth."""
    around = None
    if "capsules" in fixed:
        around = module.Obstacles(2, np.zeros(0), np.zeros((0, 7)), *fixed["rule"].tolist())
        around.place(fixed["capsules"])
    _, kind, *_, output = name.split()
    stepper = module.PrimitiveStepper(primitive_of(module, kind, fixed), float(fixed["filter"]), around)
    *start, goal, scale = given["ends"]
    stepper.start(*start, float(given["taus"][0]))
    rows = []
    for k, dt in enumerate(given["dt"].tolist()):
        if k == 3:
            stepper.change_goal(goal, scale, *([given["limit"]] if "limit" in given else []))
            stepper.change_tau(float(given["taus"][1]))
        rows.append(stepper.step(dt)[("y", "yd", "ydd").index(output)])
    return np.array(rows)


def primitive_of(module: Any, kind: str, fixed: dict[str, np.ndarray]) -> Any:
    return module.Primitive(fixed["centres"], fixed["widths"], fixed["weights"], *fixed["rates"].tolist(), kind)


def fixed_of_control(fixed: dict[str, np.ndarray]) -> tuple[Any, ...]:
    return (float(fixed["tau"]), *(fixed[key] for key in ("y0", "goal", "scale", "gains", "dead_zone", "unit")))


def controlled(law: Any, name: str, states: np.ndarray, speed: np.ndarray) -> np.ndarray:
    n = law.n
    match name:
        case "time_constant":
            return np.array([[law.time_constant(state)] for state in states])
        case "slopes" | "reference":
            return np.concatenate([np.atleast_2d(getattr(law, name)(state, speed)) for state in states])
    velocity = [state[4 * n : 5 * n] if name == "driven" else np.full(n, np.nan) for state in states]
    return np.array([law.advance(state, 0.02, 2, moved, speed) for state, moved in zip(states, velocity)])


def driven(module: Any, fixed: dict[str, np.ndarray]) -> Any:
    """Return a drive with all optional parts."""
    lines = tuple(fixed[f"line_{part}"] for part in ("joints", "cycles", "speeds", "widths", "coefficients"))
    parts = ("positions", "position_widths", "speeds", "speed_widths", "coefficients")
    over = tuple(fixed[f"map_{part}"] for part in parts)
    return module.Drive(_and_zeros(fixed["friction"]), fixed["ripple"], lines, over, fixed["warm_up"])


def _and_zeros(rows: np.ndarray) -> np.ndarray:
    """Return rows (k, n) of a table and a row of zeros for what no table has: load friction, contact doubt."""
    return np.vstack([rows, np.zeros(rows.shape[1])])


def known_of_arm(module: Any, fixed: dict[str, np.ndarray]) -> tuple[Any, ...]:
    """Return the first arguments, common to all estimators."""
    chain = module.Chain(fixed["frames"], fixed["prismatic"])
    drive = driven(module, fixed)
    gains = (fixed["gains"], float(fixed["gain_variance"]), _and_zeros(fixed["covariance"]))
    return chain, fixed["gravity"], fixed["links"], fixed["rotor"], drive, *gains


def of_estimator(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    _, method, *_, part = name.split()
    estimator = module.WrenchEstimator(
        *known_of_arm(module, fixed), fixed["bound"], fixed["prior"], float(fixed["cutoff"]), METHODS.index(method),
        fixed["point"] if " point " in name else None,
    )  # fmt: skip
    return said(estimator.run(*given.values()))[part]


def of_observer(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    words = name.split()
    estimator = module.MomentumEstimator(
        *known_of_arm(module, fixed), *(fixed[key] for key in ("prior", "memory", "qd_noise", "rate", "leak")),
        float(fixed["gain"]), "filter" in words, "biased" in words, fixed["point"] if "point" in words else None,
    )  # fmt: skip
    rows = []
    for k, row in enumerate(zip(*given.values())):
        rows.append(estimator.step(*row[:3], float(row[3])))
        if k == 1 and "biased" in words and not estimator.tare():
            raise ValueError("no tare")
    found = said(tuple(np.array(column) for column in zip(*rows)))
    return found["flags"] if words[-1] == "said" else found[words[-1]]


def said(outputs: tuple[Any, ...]) -> dict[str, Any]:
    """Return outputs by name, shares beside the one that they are of."""
    parts = ("F", "P", "observability", "error", "variance", "flags", "active", "interval")
    found = dict(zip(parts, outputs))
    shares = np.column_stack([found["observability"], np.ones(len(found["F"]))])
    return found | {"observability": shares, "said": np.column_stack([found["flags"], found["active"]])}


def of_wrench(module: Any, name: str, given: dict[str, np.ndarray], _: dict[str, np.ndarray]) -> Any:
    _, method, part, *_ = name.split()
    return module.solve_wrench(*given.values(), METHODS.index(method))[int(part)]


def of_contact(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    if name.split()[0] == "model_torque":
        drive = driven(module, fixed)
        gravity, links, rotor, *motion = given.values()
        return module.model_torque(
            module.Chain(fixed["frames"], fixed["prismatic"]), gravity, links, rotor, drive, *motion
        )
    return module.wrench_interval(*given.values())[0]


def of_obstacles(module: Any, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Any:
    rule = name.split()[-1]
    body: tuple[Any, ...] = (given["y"].shape[1], np.zeros(0), np.zeros((0, 7)))
    if "frames" in fixed:
        body = (module.Chain(fixed["frames"], fixed["prismatic"]), fixed["links"], fixed["bodies"])
    obstacles = module.Obstacles(*body, *fixed["rule"].tolist(), rule == "potential")
    obstacles.place(fixed["capsules"])
    if rule == "distance":
        return obstacles.distance(given["y"])
    return np.array([obstacles.add(*row) for row in zip(*given.values())])


FAMILIES = {
    "chains": of_chain,
    "contacts": of_contact,
    "estimators": of_estimator,
    "filters": of_filter,
    "groups": of_group,
    "limits": of_limits,
    "observers": of_observer,
    "obstacles": of_obstacles,
    "orientations": of_orientation,
    "primitives": of_primitive,
    "steppers": of_stepper,
    "wrenches": of_wrench,
}
