"""Identified inertias and friction in a URDF: other programs load it and get the model's torques."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from armlab import robots
from armlab.dynamics import base_parameters
from armlab.errors import ConfigError
from armlab.identify.consistency import LEAST, bodies_of, pseudo_inertia
from armlab.robots import inertia
from armlab.robots.urdf.writing import write_urdf

pin = pytest.importorskip("pinocchio", reason="Pinocchio is not installed")


def torques_of_pinocchio(text, rotor, q, qd, qdd):
    model = pin.buildModelFromXML(text)
    model.armature, model.gravity.linear = rotor, np.array([0, 0, -9.80665])  # its own is 9.81
    data = model.createData()
    return np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd)])


def torques_of_mujoco(text, rotor, q, qd, qdd):
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = rotor, 0.0, 0.0
    data = mujoco.MjData(model)
    model.opt.gravity[:] = [0, 0, -9.80665]
    found = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, qd, qdd):
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse.copy())
    return np.array(found)


def test_a_urdf_of_bodies_gives_their_torques_in_pinocchio_and_mujoco() -> None:
    arm, rng = robots.load("yumi_left"), np.random.default_rng(3)
    about = 1e-3 * (np.eye(3) + 0.2 * np.ones((3, 3)))
    bodies = inertia.from_body(rng.uniform(0.5, 1.5, 7), rng.uniform(-0.06, 0.06, (7, 3)), np.tile(about, (7, 1, 1)))
    text = write_urdf(replace(arm, inertias=bodies), [(0.1, 0.2)] * 7, {"rotors": "0.05"})
    q, qd, qdd = (rng.normal(size=(10, 7)) for _ in range(3))
    wanted = arm.chain.rnea(q, qd, qdd, arm.gravity, bodies) + 0.05 * qdd
    rotor = np.full(7, 0.05)
    np.testing.assert_allclose(torques_of_pinocchio(text, rotor, q, qd, qdd), wanted, rtol=0, atol=1e-9)
    np.testing.assert_allclose(torques_of_mujoco(text, rotor, q, qd, qdd), wanted, rtol=0, atol=1e-9)
    assert text.count('<dynamics damping="0.1" friction="0.2"/>') == 7
    assert "rotors: 0.05" in text


@pytest.mark.slow
def test_the_urdf_of_a_model_gives_its_torques_in_pinocchio_and_mujoco(fitted, truth) -> None:
    arm, model = truth.robot, fitted.value
    links, rotor, away = bodies_of(model, arm)
    assert np.linalg.eigvalsh(pseudo_inertia(links)).min() >= 0.5 * LEAST
    friction = list(zip(model.friction.viscous.tolist(), model.friction.coulomb_pos.tolist()))
    text = write_urdf(replace(arm, inertias=links), friction)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-1, 1, (20, 7)), rng.normal(size=(20, 7)), rng.normal(size=(20, 7))
    wanted = model.rigid_torque(q, qd, qdd)
    found = torques_of_pinocchio(text, rotor, q, qd, qdd)
    own = replace(model, link_parameters=links, rotor=rotor).rigid_torque(q, qd, qdd)
    np.testing.assert_allclose(found, own, rtol=0, atol=1e-9)
    np.testing.assert_allclose(torques_of_mujoco(text, rotor, q, qd, qdd), own, rtol=0, atol=1e-9)
    assert np.abs(own - wanted - (own - wanted).mean(axis=0)).max() < 0.05 * np.abs(wanted).max()
    assert 0.0 <= away < np.sqrt(len(model.base_names)) * 4
    assert text.count("<dynamics damping=") == 7


@pytest.mark.slow
def test_parameters_that_no_torque_shows_are_made_bodies(fitted, truth) -> None:
    """The true bodies, moved along unobservable directions until they are unphysical: their torques are recovered."""
    arm, base = truth.robot, base_parameters(truth.robot)
    rng = np.random.default_rng(3)
    about = 1e-3 * (np.eye(3) + 0.2 * np.ones((3, 3)))
    bodies = inertia.from_body(rng.uniform(0.5, 1.5, 7), rng.uniform(-0.06, 0.06, (7, 3)), np.tile(about, (7, 1, 1)))
    true = np.concatenate([bodies.ravel(), np.full(7, 0.05)])
    unseen = np.linalg.svd(base.B)[2][len(base.names) :]
    moved = true + 0.5 * unseen.T @ np.random.default_rng(2).standard_normal(len(unseen))
    model = replace(fitted.value, link_parameters=moved[:70].reshape(7, 10), rotor=moved[70:])
    assert np.linalg.eigvalsh(pseudo_inertia(model.link_parameters)).min() < 0
    links, rotor, away = bodies_of(model, arm)
    assert away == 0.0
    assert np.linalg.eigvalsh(pseudo_inertia(links)).min() > LEAST
    q, qd, qdd = (rng.normal(size=(20, 7)) for _ in range(3))
    found = replace(model, link_parameters=links, rotor=rotor).rigid_torque(q, qd, qdd)
    off = found - model.rigid_torque(q, qd, qdd)
    np.testing.assert_allclose(off, np.broadcast_to(off.mean(axis=0), off.shape), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_model_that_no_bodies_have_says_how_far_they_are(fitted, truth) -> None:
    heavy = fitted.value.link_parameters.copy()
    heavy[-1, 4:] = -0.1  # negative moments, which torques reveal
    sd = np.sqrt(np.diag(fitted.value.base_cov))
    links, _, away = bodies_of(replace(fitted.value, link_parameters=heavy), truth.robot)
    assert np.linalg.eigvalsh(pseudo_inertia(links)).min() > 0
    assert away > 1.0
    assert sd.min() > 0
    with pytest.raises(ConfigError, match="only gravity and friction"):
        bodies_of(replace(fitted.value, quasi_static=True), truth.robot)


def test_drives_are_written_and_read_back() -> None:
    n = 7
    drives = {"friction": np.linspace(0.5, 2.0, n), "damping": np.linspace(0.1, 0.3, n), "rotor": np.full(n, 0.2)}
    arm = replace(robots.load("yumi_left"), drives=tuple(drives.items()))
    text = write_urdf(arm)
    assert "drives: rotor: 0.2 0.2" in text
    known = dict(robots.urdf.parse(text).chain(tip="tool").drives)
    assert known == {name: tuple(drives[name]) for name in ("friction", "damping")}
    assert "<dynamics" not in write_urdf(replace(arm, drives=()))
