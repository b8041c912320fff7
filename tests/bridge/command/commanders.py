"""An arbiter in simulated time, for the tests of who may command."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab import robots
from armlab.bridge.arbiter import Arbiter, Order
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
HOME = np.array(LEFT.q_home)


class Bench:
    """An arbiter with a clock of its own and a list of what it says."""

    def __init__(self, arms: Any = (LEFT,), allowed: Any = ("labcomm",), **options: Any) -> None:
        self.now = 10**12
        self.events: list[str] = []
        self.warnings: list[str] = []  # those of the events that warn
        self.each: list[str] = []  # and those that are told each time
        self.answers: list[tuple[str, str]] = []
        self.arbiter = Arbiter(arms, allowed, tell=self.tell, answer=self.answer, clock=lambda: self.now, **options)
        self.q_sent = {robot.name: np.array(robot.q_home) for robot in arms}
        self.arms = arms

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        self.events.append(text)
        if warn:
            self.warnings.append(text)
        if each:
            self.each.append(text)

    def answer(self, client: str, text: str) -> None:
        self.answers.append((client, text))

    def state(self) -> State:
        made = [
            State(
                0.0, 0.004, np.array(robot.q_home), np.zeros(robot.n), np.zeros(robot.n), q_sent=self.q_sent[robot.name]
            )
            for robot in self.arms
        ]
        return made[0] if len(made) == 1 else State(0.0, 0.004, *np.zeros((3, 14)), arms=tuple(made))

    def __call__(self, *orders: Order, after: float = 0.004) -> Any:
        self.now += int(1e9 * after)
        for order in orders:
            self.arbiter.submit(order)
        command = self.arbiter(self.state())
        if isinstance(command, Command) and command.q is not None:
            self.q_sent[self.arms[0].name] = command.q
        return command


def order(client: str = "labcomm a", offset: float = 0.01, arm: str = "yumi_left", **more: Any) -> Order:
    return Order(client, arm, HOME + offset, **more)
