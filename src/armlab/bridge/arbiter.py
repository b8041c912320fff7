"""Who may command: `Arbiter`, a controller that obeys one client per arm; `Order`, what a client wants an arm to do.

Not a safety function: emergency stop and the robot's own supervision stay in charge.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.control.limits import ENTRY, Limits, axes_of, entry_refusal, joint_name, jump_refusal
from armlab.bridge.net.events import Tell, nobody
from armlab.robots import Robot
from armlab.state import Command, State


class Order(NamedTuple):
    """What a client wants an arm to do next."""

    client: str
    arm: str
    q: Any = None
    qd: Any = None
    tau: Any = None
    seq: int | None = None
    first: int | None = None
    by_axis: bool = False

    @property
    def server(self) -> str:
        """Name of the server it came through."""
        return self.client.partition(" ")[0]


def read_order(order: Order, robot: Robot, has_torque: bool = False) -> tuple[Command, str]:
    """Return the command of an order, and what is wrong with it, "" when nothing is; one bad number refuses it."""
    values: dict[str, np.ndarray | None] = {}
    for name in ("q", "qd", "tau"):
        values[name], problem = _vector(order, name, robot)
        if problem:
            return Command(), problem
    if values["tau"] is not None and not has_torque:
        problem = f"Expected no torque: {robot.name} takes none here. A cell allows it by `torque` of the robot."
        return Command(), problem
    if all(value is None for value in values.values()):
        return Command(), f"Expected a position, a velocity or a torque for {robot.name}, got none."
    return Command(values["q"], values["qd"], values["tau"]), ""


def _vector(order: Order, name: str, robot: Robot) -> tuple[np.ndarray | None, str]:
    """Return the (n,) numbers of a command, and what is wrong with them."""
    values = getattr(order, name)
    if values is None:
        return None, ""
    try:
        array = np.array(values, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != (robot.n,):
        return None, f"Expected {robot.n} numbers in {name} for {robot.name}, got {np.shape(array)}."
    if not np.isfinite(array).all():
        joint = joint_name(robot, int(np.argmin(np.isfinite(array))), order.first, order.by_axis)
        return None, f"Expected finite numbers in {name} for {robot.name}, but that of {joint} is not."
    array.flags.writeable = False
    return array, ""


LEASE = 0.1
"""Seconds of silence after which an arm is free again, the same for all servers."""

_ANSWER_EVERY = 1_000_000_000  # ns between two answers to one client
_CLIENTS = 256  # that are counted or wait; more are a flood


@dataclass(slots=True)
class _Holder:
    """Who commands an arm: the command in force, its number, and when the last one came [ns]."""

    client: str
    command: Command
    seq: int | None
    heard_ns: int


class Arbiter:
    """A controller that gives each arm the newest command of the one client that holds it, else hold.

    The first valid command of an allowed client takes a free arm. The client keeps it by commands and loses it after
    `lease` of silence, when it closes, or by `release`. The first position must lie within `entry` of the measured
    joints. A command that is refused changes nothing and keeps nothing. `stop` is for everybody, `resume` for
    operators.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        allowed: Iterable[str] = (),
        *,
        poll: Callable[[], None] = lambda: None,
        tell: Tell = nobody,
        answer: Callable[[str, str], None] = lambda client, text: None,
        lease: float = LEASE,
        entry: float = ENTRY,
        torque: Iterable[str] = (),
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._robots, self._allowed = tuple(robots), frozenset(allowed)
        self.poll, self._tell, self._answer, self._clock = poll, tell, answer, clock
        self._lease_ns, self._torque = int(1e9 * lease), frozenset(torque)
        self._limits = {robot.name: Limits.of(robot, entry=entry) for robot in robots}
        self._axes = {robot.name: axes_of(robot) for robot in robots}
        self._holders: dict[str, _Holder | None] = {robot.name: None for robot in robots}
        self._inbox: dict[tuple[str, str], tuple[int, Order]] = {}
        self._answered: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self.obeyed: dict[str, Counter[str]] = {robot.name: Counter() for robot in robots}
        self.stopped = self._reserved = ""

    def commander(self, arm: str) -> str:
        """Return who commands an arm, "" when nobody does."""
        holder = self._holder(arm)
        return "" if holder is None else holder.client

    def commands(self, client: str) -> bool:
        """Return whether a client commands an arm, or could take a free one at once: the rights of a commander."""
        holders = [holder.client for holder in map(self._holder, self._holders) if holder is not None]
        return client in holders or (not holders and client.partition(" ")[0] in self._allowed)

    def submit(self, order: Order) -> None:
        """Take what a client wants; it is judged in the next tick. Of one client and arm only the newest counts."""
        now = self._clock()
        if order.arm not in self._holders:
            known = ", ".join(self._holders)
            self._refuse(order.client, f"Expected the name of an arm of this cell ({known}), got {order.arm!r}.", now)
        elif self._reserved:
            self._refuse(order.client, f"{order.arm} is commanded by {self._reserved}. You may read.", now)
        elif order.server not in self._allowed:
            self._refuse(
                order.client, f"Expected no commands through {order.server}: `commands` does not name it.", now
            )
        elif len(self._inbox) < _CLIENTS or (order.arm, order.client) in self._inbox:
            self._inbox[order.arm, order.client] = (now, order)

    def reserve(self, who: str) -> None:
        """Refuse the commands of all clients, since the arms have a controller of their own."""
        self._reserved = who

    def stop(self, who: str) -> None:
        """Hold all arms until an operator resumes. Everybody may."""
        if not self.stopped:
            self.stopped = who
            self._tell(f"Stopped by {who}. An operator ends this: armlab bridge resume.", warn=True)
        for arm in self._holders:
            self._free(arm, "all arms were stopped")

    def resume(self, who: str) -> None:
        """End a stop; every commander begins anew by the start rule. For operators."""
        if self.stopped:
            self.release(who)
            self._inbox.clear()
            self.stopped = ""
            self._tell(f"Resumed by {who}.")

    def release(self, who: str, client: str = "") -> None:
        """Free the arms that a client holds; without one all arms."""
        for arm, holder in self._holders.items():
            if holder is not None and client in ("", holder.client):
                self._free(arm, f"released by {who}")

    def leave(self, client: str) -> None:
        for arm, holder in self._holders.items():
            self._inbox.pop((arm, client), None)
            if holder is not None and holder.client == client:
                self._free(arm, "it closed")
        self._answered.pop(client, None)

    def report(self, client: str, why: str) -> None:
        """Count what a client sent and its server refused, and tell it, at most once a second for each client."""
        self._refuse(client, why, self._clock(), answer=False)

    def __call__(self, state: State) -> Command | tuple[Command | None, ...] | None:
        """Return what each arm shall do: the newest command of its holder, or None, hold."""
        self.poll()
        now = self._clock()
        for arm in self._holders:
            if self._holder(arm) is None:
                self._free(arm, f"silent for {1e-9 * self._lease_ns:g} s")
        inbox, self._inbox = self._inbox, {}
        states = state.arms or (state,)
        by_name = dict(zip((robot.name for robot in self._robots), states, strict=True))
        fresh = set()
        for came_ns, order in tuple(inbox.values()):
            if now - came_ns > self._lease_ns:
                _count(self.refused, order.client)
            elif self._judge(order, by_name[order.arm], came_ns):
                fresh.add(order.arm)
        commands = tuple(
            self._command(robot, at, robot.name in fresh) for robot, at in zip(self._robots, states, strict=True)
        )
        return commands[0] if len(commands) == 1 else commands

    def _holder(self, arm: str) -> _Holder | None:
        """Return who holds an arm: nobody whose lease is over, also where no tick has freed it yet."""
        holder = self._holders.get(arm)
        return None if holder is None or self._clock() - holder.heard_ns > self._lease_ns else holder

    def _judge(self, order: Order, state: State, came_ns: int) -> bool:
        """Let a command come into force, for a lease from when it came; False when it was refused."""
        holder = self._holders[order.arm]
        robot = next(one for one in self._robots if one.name == order.arm)
        if self.stopped:
            return self._refuse(order.client, f"All arms hold, since {self.stopped} stopped them.", came_ns)
        if holder is not None and holder.client != order.client:
            return self._refuse(order.client, f"{order.arm} is commanded by {holder.client}. You may read.", came_ns)
        if holder is not None and None not in (order.seq, holder.seq) and order.seq <= holder.seq:  # type: ignore[operator]
            _count(self.refused, order.client)
            return False
        command, problem = read_order(order, robot, order.arm in self._torque)
        if command.q is not None and not problem:
            limits, name = self._limits[order.arm], partial(joint_name, robot, first=order.first, by_axis=order.by_axis)
            if holder is None:
                problem = entry_refusal(command.q, state.q, limits.entry, robot, name, where="is")
            else:
                problem = jump_refusal(command.q, _sent(state), limits.jump, robot, name)
        if problem:
            return self._refuse(order.client, problem, came_ns)
        if holder is None:
            self._tell(f"{order.client} commands {order.arm}.", each=True)
        self._holders[order.arm] = _Holder(order.client, command, order.seq, came_ns)
        _count(self.obeyed[order.arm], order.client)
        return True

    def _command(self, robot: Robot, state: State, is_fresh: bool) -> Command | None:
        holder = self._holders[robot.name]
        if holder is None or self.stopped:  # another thread may have taken the stop while a command came into force
            return None
        q, axes, jump = holder.command.q, self._axes[robot.name], self._limits[robot.name].jump
        if not is_fresh and q is not None and np.any(np.abs(axes(q) - axes(_sent(state))) > jump):
            return None  # the arm was held meanwhile: to go on would be a jump, which ends runs
        return holder.command

    def _free(self, arm: str, why: str) -> None:
        holder, self._holders[arm] = self._holders[arm], None
        if holder is not None:
            self._tell(f"{holder.client} no longer commands {arm}: {why}. The arm holds.", each=True)

    def _refuse(self, client: str, why: str, now: int, answer: bool = True) -> bool:
        _count(self.refused, client)
        if client not in self._answered and len(self._answered) >= _CLIENTS:
            self._answered.pop(next(iter(self._answered)))
        if now - self._answered.get(client, -_ANSWER_EVERY) >= _ANSWER_EVERY:
            self._answered[client] = now
            if answer:
                self._answer(client, f"{why} {self.refused[client]} commands refused so far.")
                self._tell(f"A command of {client} was refused: {why}", warn=True)
            else:
                self._tell(f"{client}: {why}", warn=True)
        return False


def _count(counter: Counter[str], client: str) -> None:
    """Count one; of too many clients the first is forgotten."""
    if client not in counter and len(counter) >= _CLIENTS:
        del counter[next(iter(counter))]
    counter[client] += 1


def _sent(state: State) -> np.ndarray:
    """Return the position that was sent last, the measured one before anything was."""
    q = state.q_sent
    return q if len(q) and not np.isnan(q).any() else state.q
