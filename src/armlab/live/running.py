"""A bridge that runs, seen through its local feed or over Zenoh: found, followed, and found again after its end."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.bridge.servers.watch import Watch
from armlab.bridge.servers.zenoh import Place, ZenohFeed
from armlab.contact import Estimator
from armlab.errors import LinkError, ModelMismatchError, UnknownName
from armlab.models import TorqueModel
from armlab.robots import Robot, from_toml
from armlab.state import State

__all__ = ["Force", "Running"]

_AGAIN = 0.5  # s between two looks for a bridge
_MOST = 5000  # messages taken at once: ten seconds of all rows of two arms
_PATIENCE = 2.0  # s for a bridge over Zenoh, also to come again
_GAP = 1.0  # s without a packet, after which an estimate begins anew


class Force(NamedTuple):
    """The wrench on an arm.

    Attributes
    ----------
    wrench : (6,) by the environment on the robot, base axes, at the tool point [N, N m].
    covariance : (6, 6) of it; None where it is not known. origin : who says so.
    """

    wrench: np.ndarray
    covariance: np.ndarray | None
    origin: str


class Running:
    """The newest of a bridge that runs. It only reads; what it does not read in time the feed drops.

    Parameters
    ----------
    robot : this arm only; None for all.
    cell : name of the cell; "" when only one runs. zenoh : of a bridge elsewhere, see `bridge.zenoh.Place.read`.
    rate : rows per second to ask for; with models every row is.
    models : torque models, each for the arm that it was identified on, for a bridge that sends no estimate.

    Attributes
    ----------
    robots : the arms by name, none before the first bridge was found; another object when they changed.
    row : the newest, None without any. watch : what there is to say. state : a sentence on the connection.
    """

    def __init__(
        self,
        robot: str | None = None,
        cell: str = "",
        *,
        zenoh: str = "",
        rate: float = 30.0,
        models: Sequence[TorqueModel] = (),
    ) -> None:
        if zenoh:
            Place.read(zenoh)
        self._robot, self._cell, self._zenoh, self._models = robot, cell, zenoh, tuple(models)
        self._rate = None if models else rate
        self._feed: LocalFeed | ZenohFeed | None = None
        self._due = 0.0
        self._estimates: dict[str, _Estimate] = {}
        self.robots: Mapping[str, Robot] = {}
        self.row: Row | None = None
        self.watch = Watch(robot)
        where = f"at {zenoh}" if zenoh else "of this user"
        self.state = f"Waiting for a bridge {where}, as armlab bridge --config CELL starts one."

    def close(self) -> None:
        """Leave the feed."""
        if self._feed is not None:
            self._feed.close()
        self._feed = None

    def hear(self, seconds: float) -> bool:
        """Wait for a message, take all that wait behind it, and return whether a row was among them.

        Without a bridge, look for one twice a second.

        Parameters
        ----------
        seconds : to wait at most.

        Raises
        ------
        ConfigError : several bridges run and neither cell nor arm was named. UnknownName : the arm is not in this cell.
        ModelMismatchError : a model is of no arm of this cell.
        """
        if self._feed is None:
            self._look(seconds)
        before = self.row
        try:
            for _ in range(_MOST):
                if self._feed is None or not self._feed.wait(seconds):
                    break
                self._take(self._feed.receive())
                seconds = 0.0
        except LinkError:
            self.close()
            self._due = time.monotonic() + _AGAIN
            self.state = f"The bridge of {self._cell} has ended. Waiting for it to start again."
        return self.row is not before

    def _look(self, seconds: float) -> None:
        """Look for the bridge, or wait until it is time to."""
        pause = self._due - time.monotonic()
        if pause > 0.0:
            time.sleep(min(pause, seconds))
            return
        self._due = time.monotonic() + _AGAIN
        try:
            if self._zenoh:
                self._feed = ZenohFeed(self._zenoh, self._robot or "", _PATIENCE)
            else:
                self._feed = LocalFeed(self._cell)
            self._feed.ask(Subscribe(rate=self._rate))
        except LinkError:
            self.close()
            return
        self._cell, self.state = self._feed.cell, f"Cell {self._feed.cell}"
        self.row, self.watch = None, Watch(self._robot)

    def _take(self, message: Row | dict[str, Any]) -> None:
        self.watch.take(message)
        if not isinstance(message, dict):
            self.row = message
            for estimate in self._estimates.values():
                estimate.take(message)
        elif message["kind"] == "about":
            self._meet(message["robots"])

    def _meet(self, descriptions: Mapping[str, str]) -> None:
        """Read who the arms are."""
        found = {name: from_toml(text, f"the bridge of {self._cell}") for name, text in descriptions.items()}
        if self._robot is not None and self._robot not in found:
            raise UnknownName.among("robot of this cell", self._robot, found)
        shown = {name: robot for name, robot in found.items() if self._robot in (None, name)}
        self._estimates = _estimates(self._models, shown)
        if shown != self.robots:
            self.robots = shown

    def value(self, arm: str, name: str) -> Any:
        """Return a value of an arm in the newest row.

        Parameters
        ----------
        arm : whose. name : of the field, for example "q".

        Raises
        ------
        LinkError : no row has come yet.
        """
        if self.row is None:
            raise LinkError("Expected a row of the bridge, but none has come yet. Hear first.")
        return self.row.values[f"{arm}.{name}"]

    def force(self, arm: str) -> Force | None:
        """Return the force on an arm: as its controller estimated it, else a model, else the sensor; None without any.

        Parameters
        ----------
        arm : its name.
        """
        recorded = self.value(arm, "wrench_hat")
        if np.isfinite(recorded).all():
            return Force(recorded, self.value(arm, "wrench_hat_cov"), "estimate of the controller")
        if arm in self._estimates:
            return self._estimates[arm].force
        measured = self.value(arm, "wrench")
        return Force(measured, None, "force sensor") if np.isfinite(measured).all() else None


class _Estimate:
    """The estimate of one arm by a model, packet by packet."""

    def __init__(self, model: TorqueModel, robot: Robot) -> None:
        self._name, self._estimator = robot.name, Estimator(model, robot)
        self._t, self._session = math.nan, -1
        self.force: Force | None = None

    def take(self, row: Row) -> None:
        t, dt, session, fresh, q, qd, tau = (
            row.values[f"{self._name}.{what}"] for what in ("session_t", "dt", "session", "fresh", "q", "qd", "tau")
        )
        if not fresh:
            return
        if session != self._session:
            self._estimator.reset()
        elif t > self._t:
            dt = t - self._t  # rows between may have been dropped
            if dt > _GAP:
                self._estimator.reset()
        self._t, self._session = t, session
        found = self._estimator.step(State(t, dt, q, qd, tau, robot=self._name))
        self.force = Force(found.F, found.cov, "estimate of the model")


def _estimates(models: Sequence[TorqueModel], arms: Mapping[str, Robot]) -> dict[str, _Estimate]:
    """Return the estimate of each arm that has a model."""
    found = {}
    for model in models:
        if model.robot_name not in arms:
            raise ModelMismatchError(
                f"Expected a model of {' or '.join(arms)}, got one of {model.robot_name!r}. Give the model of this arm."
            )
        found[model.robot_name] = _Estimate(model, arms[model.robot_name])
    return found
