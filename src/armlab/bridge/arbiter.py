"""Command arbitration: an `Arbiter` is a controller with one commanding client per arm; an `Order` is a client command.

Arbitration is not a safety function; rely on the emergency stop and the supervision of the robot.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armlab.bridge.control.limits import ENTRY, Limits, axes_of, entry_refusal, joint_name, jump_refusal
from armlab.bridge.net.events import Tell, nobody
from armlab.robots import Robot
from armlab.state import Command, State

if TYPE_CHECKING:
    from armlab.motion import TrajectoryController


class Order(NamedTuple):
    """Client command to an arm: references, or a trajectory with its goal name."""

    client: str
    arm: str
    q: Any = None
    qd: Any = None
    tau: Any = None
    seq: int | None = None
    first: int | None = None
    by_axis: bool = False
    goal: str = ""
    trajectory: TrajectoryController | None = None

    @property
    def server(self) -> str:
        """Name of the server to which the client is connected."""
        return self.client.partition(" ")[0]


def read_order(order: Order, robot: Robot, has_torque: bool) -> tuple[Command, str]:
    """Convert a client command to a Command; also return an error message ("" if the command as a whole is valid)."""
    values: dict[str, np.ndarray | None] = {}
    for name in ("q", "qd", "tau"):
        values[name], problem = _vector(order, name, robot)
        if problem:
            return Command(), problem
    if values["tau"] is not None and not has_torque:
        problem = (
            f"Expected a command without torque for {robot.name}, because "
            "its cell does not allow torque commands. Set `torque` of "
            "the robot in the cell file."
        )
        return Command(), problem
    if all(value is None for value in values.values()):
        return Command(), f"Expected a position, a velocity or a torque for {robot.name}, got an empty command."
    return Command(values["q"], values["qd"], values["tau"]), ""


def _vector(order: Order, name: str, robot: Robot) -> tuple[np.ndarray | None, str]:
    """Return a vector (n,) of a client command, and an error message ("" if the vector is valid)."""
    values = getattr(order, name)
    if values is None:
        return None, ""
    try:
        array = np.array(values, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != (robot.n,):
        return None, f"Expected {robot.n} numbers in {name} for {robot.name}, got shape {np.shape(array)}."
    if not np.isfinite(array).all():
        i = int(np.argmin(np.isfinite(array)))
        joint = joint_name(robot, i, order.first, order.by_axis)
        return None, f"Expected finite numbers in {name} for {robot.name}, got {array[i]} for {joint}."
    array.flags.writeable = False
    return array, ""


LEASE = 0.1
"""Duration of silence [s] after which a commanding client loses its arm; the same for all servers."""

Result = tuple[str, str, str]
"""Status of a goal ("executing", "succeeded", "canceled" or "aborted"), outcome of its trajectory, and reason."""

_RESULTS = 64  # number of stored goal results, for clients that missed them
_ANSWER_EVERY = 1_000_000_000  # ns: minimum interval between answers to a client
_CLIENTS = 256  # maximum number of counted clients and queued commands, which bounds memory


@dataclass(slots=True)
class _Holder:
    """Commanding client of an arm, with the sequence number and arrival time [ns] of its current command."""

    client: str
    command: Command
    seq: int | None
    received_ns: int
    order: Order


class Arbiter:
    """Controller that forwards the newest command of each arm's commanding client; a free arm holds its position.

    The first valid command from an allowed client takes control of a free arm. The client keeps the arm by sending
    commands, and loses it after `lease` seconds of silence, on disconnection, or through `release`. The first commanded
    position must lie within `entry` of the measured joint positions. A refused command has no effect. Any client may
    `stop`; only operators may `resume`.

    A trajectory is one long-running command: the server renews its lease while the client is connected.
    `on_goal` receives the start and the result of each goal.
    """

    poll: Callable[[], None]
    stopped: str

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
        on_goal: Callable[[Order, Result], None] = lambda order, result: None,
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
        self._on_goal, self._results = on_goal, dict[tuple[str, str], Result]()
        self._called_ns = 0
        self.refused: Counter[str] = Counter()
        self.obeyed: dict[str, Counter[str]] = {robot.name: Counter() for robot in robots}
        self.stopped = self._reserved = ""

    def commander(self, arm: str) -> str:
        """Return the commanding client of an arm, or "" if the arm is free."""
        holder = self._holder(arm)
        return "" if holder is None else holder.client

    def commands(self, client: str) -> bool:
        """Return whether a client commands an arm, or is allowed to take control and all arms are free."""
        holders = [holder.client for holder in map(self._holder, self._holders) if holder is not None]
        return client in holders or (not holders and client.partition(" ")[0] in self._allowed)

    def submit(self, order: Order) -> None:
        """Queue a command for the next tick; for each arm, only a client's newest command takes effect."""
        now, why = self._clock(), ""
        self._results.pop((order.client, order.goal), None)  # a client may reuse a goal name
        if order.arm not in self._holders:
            why = f"Expected the name of an arm of this cell ({', '.join(self._holders)}), got {order.arm!r}."
        elif self._reserved:
            why = f"{order.arm} is commanded by {self._reserved}. You have read-only access."
        elif order.server not in self._allowed:
            why = f"Expected a command through a server listed in `commands`, got a command through {order.server}."
        elif len(self._inbox) >= _CLIENTS and (order.arm, order.client) not in self._inbox:
            why = f"Expected at most {_CLIENTS} commanding clients at once." if order.goal else ""
        else:
            _, before = self._inbox.get((order.arm, order.client), (0, None))
            self._inbox[order.arm, order.client] = (now, order)
            self._end(before, "aborted", "interrupted", "A newer command replaced this command.")
        if why:
            self._refuse(order, why, now)

    def renew(self, client: str, arm: str, goal: str) -> None:
        """Renew the lease of a trajectory; the server calls this while the client is connected."""
        if not goal:
            return
        holder, (_, waiting) = self._holder(arm), self._inbox.get((arm, client), (0, None))
        now = self._clock()
        late = now - self._called_ns > self._lease_ns
        if holder is not None and (holder.client, holder.order.goal) == (client, goal):
            holder.received_ns = now
            if late:
                self._free(arm, "the arm is not ready")
        elif waiting is not None and waiting.goal == goal:
            if late:
                del self._inbox[arm, client]
                self._refuse(waiting, f"{arm} is not ready. Send the goal again when the arm is ready.", now)
        else:
            known = self._results.get((client, goal), ("aborted", "interrupted", "The lease on the arm expired."))
            self._on_goal(Order(client, arm, goal=goal), known)

    def cancel(self, who: str, arm: str, goal: str) -> None:
        """Cancel a goal and bring its arm to rest; any client may do so, as with `stop`."""
        if not goal:
            return
        holder = self._holder(arm)
        if holder is not None and holder.order.goal == goal:
            self._end(holder.order, "canceled", "interrupted", f"Canceled by {who}.")
            self._free(arm, f"canceled by {who}")
        for (place, client), (_, order) in tuple(self._inbox.items()):
            if place == arm and order.goal == goal:
                del self._inbox[arm, client]
                self._end(order, "canceled", "interrupted", f"Canceled by {who}.")

    def reserve(self, who: str) -> None:
        """Refuse all client commands from now on, because a controller commands the arms."""
        self._reserved = who

    def stop(self, who: str) -> None:
        """Hold all arms until an operator calls `resume`; any client may stop the arms."""
        if not self.stopped:
            self.stopped = who
            self._tell(f"Stopped by {who}. An operator can end the stop with armlab bridge resume.", warn=True)
        for arm in self._holders:
            self._free(arm, "all arms were stopped")

    def resume(self, who: str) -> None:
        """End a stop (operators only); each client must then restart near the current position of its arm."""
        if self.stopped:
            self.release(who)
            for _, order in self._inbox.values():
                self._end(order, "aborted", "interrupted", f"{who} ended the stop.")
            self._inbox.clear()
            self.stopped = ""
            self._tell(f"Resumed by {who}.")

    def release(self, who: str, client: str = "") -> None:
        """Release the arms commanded by a client (default: all arms)."""
        for arm, holder in self._holders.items():
            if holder is not None and client in ("", holder.client):
                self._free(arm, f"released by {who}")

    def leave(self, client: str) -> None:
        for arm, holder in self._holders.items():
            _, order = self._inbox.pop((arm, client), (0, None))
            self._end(order, "aborted", "interrupted", "The client disconnected.")
            if holder is not None and holder.client == client:
                self._free(arm, "it disconnected")
        self._answered.pop(client, None)

    def report(self, client: str, why: str) -> None:
        """Count a message refused by a server; report it at most once a second per client."""
        self._refuse(Order(client, ""), why, self._clock(), answer=False)

    def __call__(self, state: State) -> Command | tuple[Command | None, ...] | None:
        """Return the newest command of each arm's commanding client, or None (hold)."""
        self.poll()
        now = self._called_ns = self._clock()
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
                self._end(order, "aborted", "refused", f"{order.arm} was not ready. Send the goal again.")
            elif self._judge(order, by_name[order.arm], came_ns):
                fresh.add(order.arm)
        commands = tuple(
            self._command(robot, at, robot.name in fresh, state.dt)
            for robot, at in zip(self._robots, states, strict=True)
        )
        return commands[0] if len(commands) == 1 else commands

    def _holder(self, arm: str) -> _Holder | None:
        """Return the commanding client of an arm, or None once its lease has expired."""
        holder = self._holders.get(arm)
        return None if holder is None or self._clock() - holder.received_ns > self._lease_ns else holder

    def _judge(self, order: Order, state: State, came_ns: int) -> bool:
        """Activate a command for one lease period from its arrival; return False if the command is refused."""
        holder = self._holders[order.arm]
        robot = next(one for one in self._robots if one.name == order.arm)
        if self.stopped:
            return self._refuse(order, f"All arms hold their positions, because {self.stopped} stopped them.", came_ns)
        if holder is not None and holder.client != order.client:
            return self._refuse(
                order, f"{order.arm} is commanded by {holder.client}. You have read-only access.", came_ns
            )
        if holder is not None and None not in (order.seq, holder.seq) and order.seq <= holder.seq:  # type: ignore[operator]
            _count(self.refused, order.client)
            return False
        if order.trajectory is not None:
            limits = self._limits[order.arm]
            problem = order.trajectory.begin(state, limits.entry, is_moving=holder is not None)
            command = Command()
        else:
            command, problem = read_order(order, robot, order.arm in self._torque)
        if command.q is not None and not problem:
            limits, name = self._limits[order.arm], partial(joint_name, robot, first=order.first, by_axis=order.by_axis)
            if holder is None:
                problem = entry_refusal(command.q, state.q, limits.entry, robot, name, where="is")
            else:
                problem = jump_refusal(command.q, _sent(state), limits.jump, robot, name)
        if problem:
            return self._refuse(order, problem, came_ns)
        if holder is None:
            self._tell(f"{order.client} commands {order.arm}.", each=True)
        else:
            self._end(holder.order, "aborted", "interrupted", "A newer command replaced this command.")
        self._holders[order.arm] = _Holder(order.client, command, order.seq, came_ns, order)
        if order.goal:
            self._on_goal(order, ("executing", "", ""))
        _count(self.obeyed[order.arm], order.client)
        return True

    def _command(self, robot: Robot, state: State, is_fresh: bool, dt: float) -> Command | None:
        holder = self._holders[robot.name]
        if holder is None or self.stopped:  # another thread may have stopped the arms
            return None
        if holder.order.trajectory is not None:
            return self._follow(holder.order, holder.order.trajectory, state, 0.0 if is_fresh else dt)
        q, axes, jump = holder.command.q, self._axes[robot.name], self._limits[robot.name].jump
        if not is_fresh and q is not None and np.any(np.abs(axes(q) - axes(_sent(state))) > jump):
            return None  # the arm has held since this command; resuming it would cause a jump, which ends the run
        return holder.command

    def _follow(self, order: Order, trajectory: TrajectoryController, state: State, dt: float) -> Command | None:
        """Return the next trajectory command, or None if the trajectory ended or its reference is too far away."""
        command, axes = trajectory(state, dt), self._axes[order.arm]
        is_far = command.q is not None and not np.all(
            np.abs(axes(command.q) - axes(_sent(state))) <= self._limits[order.arm].jump
        )  # NaN counts as far
        if not is_far and not trajectory.ending:
            return command
        reason = "The arm's limits prevent it from following the trajectory." if is_far else trajectory.reason
        self._end(order, "succeeded" if trajectory.done else "aborted", trajectory.ending or "path", reason)
        self._free(order.arm, reason or "the trajectory has ended")
        return None

    def _end(self, order: Order | None, status: str, ending: str, reason: str) -> None:
        """Report the result of a goal once; commands without a goal have no result."""
        if order is not None and order.goal and (order.client, order.goal) not in self._results:
            self._results[order.client, order.goal] = found = status, ending, reason
            while len(self._results) > _RESULTS:
                del self._results[next(iter(self._results))]
            self._on_goal(order, found)

    def _free(self, arm: str, why: str) -> None:
        holder, self._holders[arm] = self._holders[arm], None
        if holder is not None:
            self._end(holder.order, "aborted", "interrupted", f"{why[:1].upper()}{why[1:]}.")
            self._tell(f"{holder.client} no longer commands {arm}: {why.rstrip('.')}. The arm holds.", each=True)

    def _refuse(self, order: Order, why: str, now: int, answer: bool = True) -> bool:
        client = order.client
        _count(self.refused, client)
        self._end(order, "aborted", "refused", why)
        if client not in self._answered and len(self._answered) >= _CLIENTS:
            self._answered.pop(next(iter(self._answered)))
        if now - self._answered.get(client, -_ANSWER_EVERY) >= _ANSWER_EVERY:
            self._answered[client] = now
            if answer and order.goal:  # the result of the goal contains the reason
                self._tell(f"A trajectory of {client} was refused: {why}", warn=True)
            elif answer:
                self._answer(client, f"{why} {self.refused[client]} commands refused so far.")
                self._tell(f"A command of {client} was refused: {why}", warn=True)
            else:
                self._tell(f"{client}: {why}", warn=True)
        return False


def _count(counter: Counter[str], client: str) -> None:
    """Count a client; if the counter is full, remove its oldest entry."""
    if client not in counter and len(counter) >= _CLIENTS:
        del counter[next(iter(counter))]
    counter[client] += 1


def _sent(state: State) -> np.ndarray:
    """Return the last commanded position, or the measured position before the first command."""
    q = state.q_sent
    return q if len(q) and not np.isnan(q).any() else state.q
