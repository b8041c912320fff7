"""Force sensors and accelerometers calibrated by gravity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import sim
from armlab.calibrate import fit_accelerometer, fit_force_sensor
from armlab.calibrate.gravity_load.model import Load, WeightEquation, mirror_solution
from armlab.errors import NotConverged, NotExcited
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3
from armlab.sim.experiments import sensors

G = np.array([0.0, 0.0, -9.82])
WRENCH = ("force [N]",) * 3 + ("torque [N m]",) * 3
NOISE = {3: 0.1, 6: (0.1, 0.005)}
TILT = np.radians(30.0)
G_ACCELEROMETER = np.array([0.0, 0.0, -9.80665])
SIGMA = 0.02


def variances(width: int) -> np.ndarray:
    return np.repeat(np.square(NOISE[width]), 3)[:width] if width == 6 else np.full(3, 0.01)


def equation_of(data: Any, pull: Any = G, noise: Any = None, bias: bool = True) -> WeightEquation:
    return WeightEquation(data.RA, data.y, pull, bias, None, noise, WRENCH[: data.y.shape[1]], "force sensor")


def error(fit: Fit[Any], truth: dict[str, Any]) -> np.ndarray:
    """Return the error in the coordinates of the covariance: R = truth Exp(w), mass or weight, bias, centre, bias."""
    value = fit.value
    parts = [so3.log(truth["R"].T @ value.R_tool_sensor)]
    known = [value.mass - truth.get("mass", 1.0)]
    parts.append(value.mass * value.gravity - truth["gamma"] if "weight x" in fit.names else known)
    parts.append(value.bias[:3] - truth["bias"][:3])
    if len(truth["bias"]) == 6:
        parts += [value.centre - truth["centre"], value.bias[3:] - truth["bias"][3:]]
    return np.concatenate(parts)


def truth_of(data: Any) -> dict[str, Any]:
    return {"R": data.R, "bias": data.bias, "centre": data.centre, "gamma": G}


@pytest.mark.parametrize("gravity", [G, np.array([3.0, -2.0, 7.0])], ids=["upright", "tilted base"])
@pytest.mark.parametrize("torque", [None, 0.0], ids=["forces", "torques"])
@pytest.mark.parametrize("sign", [1, -1])
def test_exact_data_give_the_exact_answer(gravity, torque, sign) -> None:
    data = sensors.weighed(0, 20, 0.0, torque=torque)
    u = sign * 0.7 * (gravity @ data.RA @ data.R)
    y = u + data.bias[:3] if torque is None else np.hstack([u, np.cross(data.centre, u)]) + data.bias
    fit = fit_force_sensor(se3.from_rp(data.RA, np.zeros((20, 3))), y, gravity=gravity, sign=sign)
    value = fit.value
    np.testing.assert_allclose(value.R_tool_sensor, data.R, atol=1e-12)
    np.testing.assert_allclose(value.mass, 0.7, atol=1e-12)
    np.testing.assert_allclose(value.bias[: y.shape[1]], data.bias, atol=1e-11)
    np.testing.assert_array_equal(value.gravity, gravity)
    assert value.sign == sign
    if torque is None:
        assert np.isnan(value.centre).all()
        assert np.isnan(value.bias[3:]).all()
    else:
        np.testing.assert_allclose(value.centre, data.centre, atol=1e-12)
        found = value.contact(y, se3.from_rp(data.RA, np.zeros((20, 3))))
        np.testing.assert_allclose(found, 0.0, atol=1e-10)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("torque", [None, 0.0], ids=["forces", "torques"])
def test_unknown_gravity(bias, torque) -> None:
    data = sensors.weighed(5, 20, 0.0, torque=torque)
    gamma = np.array([2.0, -5.0, 3.0])
    u = gamma @ data.RA @ data.R
    b = data.bias * bias
    y = u + b[:3] if torque is None else np.hstack([u, np.cross(data.centre, u)]) + b
    fit = fit_force_sensor(data.RA, y, gravity="unknown", bias=bias)
    np.testing.assert_allclose(fit.value.R_tool_sensor, data.R, atol=1e-11)
    np.testing.assert_allclose(fit.value.mass, np.linalg.norm(gamma) / 9.80665, rtol=1e-12)
    np.testing.assert_allclose(fit.value.mass * fit.value.gravity, gamma, atol=1e-11)
    assert "the sign of the sensor is not identifiable" in fit.report()
    assert "weight z" in fit.names
    other = fit_force_sensor(data.RA, y, gravity="unknown", bias=bias, sign=-1)
    np.testing.assert_allclose(other.value.gravity, -fit.value.gravity, atol=1e-11)


def test_the_closed_form_is_the_most_likely_value() -> None:
    for seed, tilt in ((0, None), (1, 0.5)):
        data = sensors.weighed(seed, tilt=tilt)
        sizes = np.random.default_rng(seed).uniform(0.05, 0.3, 100)
        cov = np.square(sizes)[:, None, None] * np.eye(3)
        for noise in (0.1, cov):
            fit = fit_force_sensor(**data.given, noise=noise)
            start = equation_of(data, noise=np.full(3, 0.01) if noise is not cov else cov).start()
            np.testing.assert_allclose(fit.value.R_tool_sensor, start.R, atol=1e-9)
            np.testing.assert_allclose(fit.value.bias[:3], start.bias, atol=1e-8)


def test_the_unit_of_mass_and_of_force_does_not_matter() -> None:
    """Defect of the original: its result depended on the guessed mass."""
    data = sensors.weighed(3, sigma=1.0, tilt=0.5)
    one = fit_force_sensor(**data.given)
    grams = fit_force_sensor(data.RA, data.y, gravity=G * 1e-3)
    np.testing.assert_allclose(grams.value.R_tool_sensor, one.value.R_tool_sensor, atol=1e-12)
    assert grams.value.mass == pytest.approx(1e3 * one.value.mass, rel=1e-12)
    kilo = fit_force_sensor(data.RA, 1e-3 * data.y, gravity=G)
    np.testing.assert_allclose(kilo.value.R_tool_sensor, one.value.R_tool_sensor, atol=1e-12)


@pytest.mark.parametrize(("robust", "known", "torque"), [(False, True, None), (True, False, 0.005)])
def test_mirrored_axes_and_reversed_signs_are_refused(robust, known, torque) -> None:
    data = sensors.weighed(4, torque=torque)
    noise = NOISE[data.y.shape[1]] if known else None
    for mirror in (np.diag([1.0, 1, -1]), -np.eye(3)):
        y = data.y.copy()
        y[:, :3] = y[:, :3] @ mirror
        with pytest.raises(NotConverged, match="An axis is mirrored or the sign is reversed") as caught:
            fit_force_sensor(data.RA, y, gravity=G, noise=noise, robust=bool(robust))
        assert caught.value.reason == "left_handed"
        np.testing.assert_allclose(caught.value.best.R, data.R @ mirror, atol=0.05)
    with pytest.raises(NotConverged) as caught:
        fit_force_sensor(**data.given, sign=-1, noise=noise, robust=bool(robust))
    assert caught.value.reason == "left_handed"


def test_two_deviations_of_noise_are_found() -> None:
    found = [fit_force_sensor(**sensors.weighed([7, run], torque=0.005).given).sigma for run in range(12)]
    np.testing.assert_allclose(np.mean(found, axis=0), (0.1, 0.005), rtol=0.05)


UPRIGHT = so3.exp(np.linspace(0.0, 3.0, 100)[:, None] * [0.0, 0.0, 1.0])
SHORT_ARC = so3.exp(np.radians(np.linspace(-3.0, 3.0, 100))[:, None] * [1.0, 0.0, 0.0])


def readings(RA: np.ndarray, sigma: float = 0.1) -> dict[str, Any]:
    y = G @ RA + sigma * np.random.default_rng(1).standard_normal((len(RA), 3))
    return {"T_base_tool": RA, "wrench": y, "gravity": G}


REFUSALS = {
    "gravity in tool axes is constant (rotations about the vertical only)": readings(UPRIGHT),
    "rotation about tool axis y, bias along it": {**readings(SHORT_ARC), "noise": 0.1},
    "rotation about tool axis y": readings(SHORT_ARC),
    "2 samples": readings(SHORT_ARC[:2]),
}


def experiment_of(torque: float | None, tilt: float | None, unknown: bool):
    def experiment(seed: int, n: int) -> Experiment:
        data = sensors.weighed([3000, seed], n, tilt=tilt, torque=torque)
        equation = equation_of(data, None if unknown else G, variances(data.y.shape[1]))
        (truth,) = equation.evaluate(Load(data.R, G, data.bias, data.centre))
        assert truth.cov is not None
        bound = np.linalg.inv(np.sum(np.swapaxes(truth.J, 1, 2) @ (truth.J / truth.cov[:, None]), axis=0))
        given = {**data.given, "noise": NOISE[data.y.shape[1]]}
        return Experiment(given | {"gravity": "unknown"} if unknown else given, truth_of(data), bound)

    return experiment


def gauges(known: bool) -> list[Gauge]:
    S = so3.exp([0.3, -1.0, 0.5])

    def moved(fit: Fit[Any], **changed: np.ndarray) -> dict[str, Any]:
        value = fit.value
        count = 6 if np.isfinite(value.centre).all() else 3
        now = {"R": value.R_tool_sensor, "bias": value.bias[:count], "centre": value.centre}
        return now | {"gamma": value.mass * value.gravity, "mass": value.mass} | changed

    def base(data: dict[str, Any]) -> dict[str, Any]:
        turned = {"gravity": S @ data["gravity"]} if known else {}
        return {**data, "T_base_tool": S @ data["T_base_tool"], **turned}

    return [
        Gauge("base turned", base, lambda f: moved(f, gamma=S @ (f.value.mass * f.value.gravity))),
        Gauge(
            "tool turned", lambda d: {**d, "T_base_tool": d["T_base_tool"] @ S},
            lambda f: moved(f, R=S.T @ f.value.R_tool_sensor),
        ),
    ]  # fmt: skip


@pytest.mark.parametrize(("runs", "torque", "tilt", "unknown"), [
    (12, None, None, False),
    (8, 0.005, None, True),
    pytest.param(120, None, None, False, marks=pytest.mark.slow),  # 8 s in all
    pytest.param(120, None, TILT, False, marks=pytest.mark.slow),
    pytest.param(120, 0.005, None, False, marks=pytest.mark.slow),
    pytest.param(120, None, None, True, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_statistical_contract(runs: int, torque: float | None, tilt: float | None, unknown: bool) -> None:
    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        bad = np.zeros(len(data["wrench"]), dtype=bool)
        bad[rng.choice(len(bad), max(len(bad) // 20, 1), replace=False)] = True
        return {**data, "wrench": sensors.touched(rng, data["wrench"], bad), "robust": True}, bad

    found = check_estimator(
        fit_force_sensor, experiment_of(torque, tilt, unknown), runs, n=100, error=error,
        gauges=gauges(not unknown), refusals=REFUSALS, spoil=spoil,
    )  # fmt: skip
    assert found.passed, found.text()


@pytest.mark.parametrize("options", [{}, {"noise": 0.1}, {"robust": True}, {"bias": False}, {"gravity": "unknown"}])
def test_readings_without_weight_are_refused(options) -> None:
    with pytest.raises(NotExcited, match="Expected the readings of the force sensor to contain a weight, got zero"):
        fit_force_sensor(sensors.weighed(9).RA, np.zeros((100, 3)), **options)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_difference_that_noise_may_have_made_decides_no_hand(sign: int) -> None:
    """At tilts of 30 degrees and 1 N of noise, chi squared differs by 9 either way, which is too little to decide."""
    weighed = sim.cell(0).force(N=40, sigma=1.0, tilt=np.deg2rad(30))
    report = fit_force_sensor(weighed.RA, weighed.y, gravity=G, sign=sign).report()
    assert f"handedness and sign of the sensor are undecided (Delta {8.8 * sign}" in report


@pytest.mark.parametrize(("known", "torque", "unknown", "N", "bad"), [
    (True, None, True, 100, 30),
    (False, None, True, 20, 4),
    (False, 0.005, True, 100, 30),
    (True, 0.005, False, 20, 4),
    (False, None, False, 100, 30),
])  # fmt: skip
def test_contacts_do_not_lead_to_another_answer(known, torque, unknown, N, bad) -> None:
    """Small tilts and unknown gravity: most of these fits ended half a turn away if started from all samples."""
    for run in range(2):
        data = sensors.weighed([20, run], N, tilt=TILT, torque=torque)
        y = sensors.touched(np.random.default_rng(run), data.y, slice(0, bad))
        fit = fit_force_sensor(
            data.RA, y, gravity="unknown" if unknown else G, robust=True,
            noise=(0.1 if torque is None else (0.1, torque)) if known else None,
        )  # fmt: skip
        assert fit.outliers[:bad].all()
        assert fit.outliers.sum() <= bad + 3
        e = so3.log(data.R.T @ fit.value.R_tool_sensor)
        assert e @ np.linalg.solve(fit.cov[:3, :3], e) < 25.0
        np.testing.assert_allclose(fit.value.mass * fit.value.gravity, G, atol=6 * 0.1)
        assert "outliers excluded" in fit.report()


@pytest.mark.parametrize("torque", [None, 0.0], ids=["forces", "torques"])
def test_the_twin_reads_the_same_to_first_order(torque) -> None:
    for tilt in (0.2, 0.02):
        data = sensors.weighed(22, sigma=0.0, tilt=tilt, torque=torque)
        equation = equation_of(data, None)
        other = mirror_solution(equation, Load(data.R, G, data.bias, data.centre))
        assert other is not None
        assert np.abs(so3.log(data.R.T @ other.R)).max() > 1.0
        np.testing.assert_array_equal(other.gamma, -G)
        swing = np.abs(data.y - data.y.mean(axis=0)).max()
        assert np.abs(equation.evaluate(other)[0].r).max() < tilt * swing


def test_where_there_is_no_twin() -> None:
    for tilt, bias in ((None, True), (0.1, False)):
        data = sensors.weighed(23, tilt=tilt)
        assert mirror_solution(equation_of(data, None, bias=bias), Load(data.R, G, data.bias, data.centre)) is None


@pytest.mark.parametrize(
    ("bias", "torque", "robust"), [(True, None, False), (True, 0.005, True), (False, None, True), (False, 0.005, False)]
)
def test_a_known_mass_is_kept_in_every_kind_of_fit(bias, torque, robust) -> None:
    data = sensors.weighed(14, torque=torque)
    y = data.y if bias else data.y - data.bias
    y[:4] += 20.0 * robust
    fit = fit_force_sensor(data.RA, y, gravity=G, mass=1.0, bias=bias, noise=NOISE[y.shape[1]], robust=robust)
    assert fit.value.mass == pytest.approx(1.0, abs=1e-12)
    assert "mass" not in fit.names
    assert len(fit.names) == 3 + 3 * bias + (3 + 3 * bias) * (torque is not None)
    assert fit.outliers[:4].all() == robust
    if bias and not robust:  # the known mass helps, and the rotation is the same for any mass
        free = fit_force_sensor(data.RA, y, gravity=G, noise=NOISE[y.shape[1]])
        assert np.trace(fit.cov[3:, 3:]) < np.trace(free.cov[4:, 4:])
        np.testing.assert_allclose(fit.value.R_tool_sensor, free.value.R_tool_sensor, atol=1e-8)
    np.testing.assert_allclose(so3.log(data.R.T @ fit.value.R_tool_sensor), 0.0, atol=5 * fit.sd[:3].max())
    if not bias:
        np.testing.assert_array_equal(fit.value.bias[: y.shape[1]], 0.0)


@pytest.mark.parametrize("width", [3, 6])
def test_unequal_noise_counts_by_its_size(width) -> None:
    told, equal = [], []
    for run in range(16):
        data, rng = sensors.weighed([15, run], torque=None if width == 3 else 0.005), np.random.default_rng([15, run])
        scale = np.array([0.05, 0.5, 0.1, 0.002, 0.02, 0.005])[:width]
        mix = scale[:, None] * (np.eye(width) + 0.3 * rng.standard_normal((width, width)))
        size = np.linspace(0.2, 3.0, 100)[:, None]
        y = data.exact + size * rng.standard_normal((100, width)) @ mix.T
        cov = size[:, :, None] ** 2 * (mix @ mix.T)
        fit = fit_force_sensor(data.RA, y, gravity=G, noise=cov)
        for one, values in ((fit, told), (fit_force_sensor(data.RA, y, gravity=G), equal)):
            e = error(one, truth_of(data))
            values.append(e @ np.linalg.solve(fit.cov, e) / len(e))
    assert 0.8 < np.mean(told) < 1.2
    assert np.mean(equal) > 4.0 * np.mean(told)


@pytest.mark.parametrize("width", [3, 6])
def test_noise_in_its_forms_is_the_same_noise(width) -> None:
    data = sensors.weighed(16, torque=None if width == 3 else 0.005)
    S = np.diag(np.repeat(np.square(NOISE[width]), 3))
    first, *others = (fit_force_sensor(**data.given, noise=n) for n in (NOISE[width], S, np.tile(S, (100, 1, 1))))
    for other in others:
        np.testing.assert_allclose(other.parameters, first.parameters, atol=1e-9)
        np.testing.assert_allclose(other.cov, first.cov, rtol=1e-6, atol=1e-12)


def test_orientations_and_poses_are_the_same() -> None:
    """Defect of the original: it failed on 4x4 poses."""
    data = sensors.weighed(17)
    poses = se3.from_rp(data.RA, np.random.default_rng(0).standard_normal((100, 3)))
    first, second = (fit_force_sensor(T, data.y, gravity=G) for T in (data.RA, poses))
    assert first.parameters.tobytes() == second.parameters.tobytes()


def test_torques_sharpen_the_rotation() -> None:
    """Defect of the original: torques were never used."""
    data = sensors.weighed(18, torque=0.005)
    both = fit_force_sensor(**data.given, noise=NOISE[6])
    forces = fit_force_sensor(data.RA, data.y[:, :3], gravity=G, noise=0.1)
    assert np.trace(both.cov[:3, :3]) < 0.5 * np.trace(forces.cov[:3, :3])


def error_of_acc(fit: Fit[Any], truth: dict[str, Any]) -> np.ndarray:
    parts = [so3.log(truth["R"].T @ fit.value.R_tool_sensor)]
    parts += [[fit.value.scale - truth["scale"]]] if "scale" in fit.names else []
    return np.concatenate([*parts, fit.value.bias - truth["bias"]])


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_exact_data_give_the_exact_answer_accelerometer(scale: float) -> None:
    data = sensors.accelerated(0, sigma=0.0)
    poses, acc = se3.from_rp(data.RA, np.ones((50, 3))), scale * (data.y - data.bias) + data.bias
    fit = fit_accelerometer(poses, acc, scale=scale != 1.0)
    np.testing.assert_allclose(error_of_acc(fit, {"R": data.R, "bias": data.bias, "scale": scale}), 0.0, atol=1e-12)
    assert ("scale" in fit.names) is (scale != 1.0)
    assert fit.value.scale == pytest.approx(scale, abs=1e-12)
    np.testing.assert_allclose(fit.value.acceleration(acc, poses), 0.0, atol=1e-10)


def experiment_of_acc(scale: bool):
    def experiment(seed: int, n: int) -> Experiment:
        data = sensors.accelerated([3500, seed], n, SIGMA)
        equation = WeightEquation(
            data.RA, data.y, data.weight, True, None if scale else 1.0, np.full(3, SIGMA**2), ("a",) * 3, ""
        )
        (at,) = equation.evaluate(Load(data.R, data.weight, data.bias, np.zeros(3)))
        J = at.J.reshape(-1, at.J.shape[2]) / SIGMA
        given = {"T_base_tool": data.RA, "acc": data.y, "noise": SIGMA, "gravity": G_ACCELEROMETER, "scale": scale}
        return Experiment(given, {"R": data.R, "bias": data.bias, "scale": 1.0}, np.linalg.inv(J.T @ J))

    return experiment


@pytest.mark.parametrize(
    ("runs", "scale"), [(8, True), *(pytest.param(100, scale, marks=pytest.mark.slow) for scale in (False, True))]
)
def test_the_statistical_contract_acc(runs: int, scale: bool) -> None:
    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        bad = np.zeros(len(data["acc"]), dtype=bool)
        bad[rng.choice(len(bad), max(len(bad) // 20, 1), replace=False)] = True
        acc = data["acc"].copy()
        acc[bad] += 3.0 * sensors.rotations(rng, int(bad.sum()))[:, 0]
        return {**data, "acc": acc, "robust": True}, bad

    S = so3.exp([0.3, -1.0, 0.5])

    def same(fit: Fit[Any], **changed: np.ndarray) -> dict[str, Any]:
        value = fit.value
        return {"R": value.R_tool_sensor, "bias": value.bias, "scale": value.scale, **changed}

    gauges = [
        Gauge("base turned", lambda d: {**d, "T_base_tool": S @ d["T_base_tool"], "gravity": S @ d["gravity"]}, same),
        Gauge("tool turned", lambda d: {**d, "T_base_tool": d["T_base_tool"] @ S},
              lambda f: same(f, R=S.T @ f.value.R_tool_sensor)),
    ]  # fmt: skip
    refusals = {"about the vertical only": {"T_base_tool": UPRIGHT, "acc": -(G_ACCELEROMETER @ UPRIGHT)}}
    found = check_estimator(
        fit_accelerometer, experiment_of_acc(scale), runs, n=50, error=error_of_acc, gauges=gauges,
        refusals=refusals, spoil=spoil,
    )  # fmt: skip
    assert found.passed, found.text()
