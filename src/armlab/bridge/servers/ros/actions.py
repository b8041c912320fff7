"""Trajectories of ROS clients: `Goals` converts messages to loop requests; `ActionServers` serves ROS 2 nodes."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from secrets import token_hex
from typing import Annotated, Any

import msgspec
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from armlab.bridge.servers.messages import Cancel, Renew, Report, TrajectoryRequest, limits_of_cell
from armlab.bridge.servers.ros.services import Respond, Service, register
from armlab.bridge.servers.ros.topics import ArmRow, RosTopic, store
from armlab.bridge.servers.row import places, read_head
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import ArmlabError, CommandRefused, UnknownName
from armlab.motion import JointTrajectory, Tolerance
from armlab.motion.trajectory import GOAL_TIME, GOAL_TOLERANCE
from armlab.robots import Robot

TRAJECTORY, FOLLOW = "trajectory_msgs/msg/JointTrajectory", "control_msgs/action/FollowJointTrajectory"
CONTROLLER = "joint_trajectory_controller"
STATUS, CANCEL = "action_msgs/msg/GoalStatusArray", "action_msgs/srv/CancelGoal"
ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 3, 4, 5, 6
"""Status codes of a goal; see action_msgs/msg/GoalStatus."""

_STATUS = {"executing": EXECUTING, "succeeded": SUCCEEDED, "canceled": CANCELED, "aborted": ABORTED}
_CODES = {"arrived": 0, "refused": -1, "interrupted": -1, "path": -4, "goal": -5}  # error codes of the action's result
_JOINTS_CODE = -2
_MOST = 64  # maximum number of simultaneous goals per server
_RENEW = 25_000_000  # ns between renewals of a lease
_FEEDBACK = 50_000_000  # ns between feedback messages
_PART = 24_000  # bytes of trajectory points per request
_POINTS = 2000  # maximum number of points: reading a message must take only a fraction of a client's lease
_LONGEST_DELAY = 60.0  # s: maximum delay before a trajectory begins


_Whole = Annotated[int, msgspec.Meta(ge=-(2**31), lt=2**32)]
_Name = Annotated[str, msgspec.Meta(max_length=256)]


class _Duration(msgspec.Struct):
    """Time or duration with the field names of ROS 1 or ROS 2."""

    sec: _Whole = 0
    nanosec: _Whole = 0
    secs: _Whole = 0
    nsecs: _Whole = 0

    @property
    def seconds(self) -> float:
        return self.sec + self.secs + 1e-9 * (self.nanosec + self.nsecs)


_Numbers = Annotated[list[float], msgspec.Meta(max_length=64)]


class _Point(msgspec.Struct):
    positions: _Numbers = []
    velocities: _Numbers = []
    accelerations: _Numbers = []
    effort: _Numbers = []
    time_from_start: _Duration = msgspec.field(default_factory=_Duration)


class _Header(msgspec.Struct):
    stamp: _Duration = msgspec.field(default_factory=_Duration)


class _Trajectory(msgspec.Struct):
    header: _Header = msgspec.field(default_factory=_Header)
    joint_names: Annotated[list[_Name], msgspec.Meta(max_length=64)] = []
    points: Annotated[list[_Point], msgspec.Meta(max_length=_POINTS)] = []


class _JointTolerance(msgspec.Struct):
    name: _Name = ""
    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0


class _Several(msgspec.Struct):
    joint_names: list[str] = []


class _Goal(msgspec.Struct):
    trajectory: _Trajectory = msgspec.field(default_factory=_Trajectory)
    multi_dof_trajectory: _Several = msgspec.field(default_factory=_Several)
    path_tolerance: list[_JointTolerance] = []
    goal_tolerance: list[_JointTolerance] = []
    component_path_tolerance: list[Any] = []
    component_goal_tolerance: list[Any] = []
    goal_time_tolerance: _Duration = msgspec.field(default_factory=_Duration)


def read_trajectory(message: Mapping[str, Any]) -> JointTrajectory:
    """Convert a ROS 1 or ROS 2 JointTrajectory message to a trajectory."""
    return _trajectory(_converted(message, _Trajectory))


def _converted(message: Any, kind: type[Any]) -> Any:
    try:
        return msgspec.convert(message, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        name = "JointTrajectory" if kind is _Trajectory else "FollowJointTrajectory goal"
        raise CommandRefused(f"Expected a {name}, got an invalid field: {str(error).rstrip('.')}.") from None


def _trajectory(message: _Trajectory) -> JointTrajectory:
    if not message.points:
        raise CommandRefused("Expected a trajectory with points, got none. To stop, cancel the goal.")
    if not message.joint_names:
        raise UnknownName("Expected the joint names in joint_names, got none.")
    n, columns = len(message.joint_names), dict[str, np.ndarray | None]()
    for name, what in (("q", "positions"), ("qd", "velocities"), ("qdd", "accelerations"), ("effort", "effort")):
        rows = [getattr(point, what) for point in message.points]
        if not any(rows):
            columns[name] = None
            continue
        wrong = next((k for k, row in enumerate(rows) if len(row) != n), None)
        if wrong is not None:
            raise CommandRefused(
                f"Expected {n} {what} in every point, one per joint, got {len(rows[wrong])} in point {wrong}."
            )
        columns[name] = np.array(rows)
    q, effort = columns["q"], columns.pop("effort")
    if q is None or (effort is not None and effort.any()):
        raise CommandRefused("Expected positions in every point and no effort. Add positions and remove the effort.")
    t = np.array([point.time_from_start.seconds for point in message.points])
    return JointTrajectory(t, q, columns["qd"], columns["qdd"], message.joint_names)


def _tolerance(given: Iterable[_JointTolerance], robot: Robot, usual: Tolerance) -> Tolerance:
    """Return the tolerances of a goal; zero selects the default, and a negative number disables the check."""
    values = usual.spread(robot.n)
    for one in given:
        if one.name not in robot.ros_joint_names:
            raise UnknownName.among("joint", one.name[:80], robot.ros_joint_names)
        if one.acceleration > 0.0:
            raise CommandRefused(
                "Expected no acceleration tolerance, because accelerations are not measured. Set the tolerance to 0."
            )
        i = robot.ros_joint_names.index(one.name)
        for row, value in zip(values, (one.position, one.velocity), strict=True):
            if value != 0.0:
                row[i] = math.inf if value < 0.0 else value
    return Tolerance(*values)


@dataclass
class Goal:
    """Trajectory goal of a client."""

    client: str
    arm: str
    name: str
    on_result: Callable[[int, int, str], None]  # called once, with the status, error code and text
    on_feedback: Callable[[dict[str, Any]], None] | None = None
    on_status: Callable[[int], None] = lambda status: None
    is_message: bool = False
    begin: float = 0.0
    since_ns: int | None = None
    feedback_ns: int = 0
    is_sent: bool = False
    is_running: bool = False


class Goals:
    """Trajectories of all clients of a server: their requests, leases, feedback and results."""

    def __init__(self, loop: LoopEnd) -> None:
        self._loop, self._robots = loop, loop.robots()
        self._limits = limits_of_cell(self._robots.values(), loop.about)
        self._places = {name: places(loop.schema, name) for name in self._robots}
        self._goals: dict[tuple[str, str], Goal] = {}
        self._renewed_ns = 0
        self.topics: dict[str, str] = {f"/{name}/{CONTROLLER}/joint_trajectory": TRAJECTORY for name in self._robots}
        self.actions: dict[str, str] = {f"/{name}/{CONTROLLER}/follow_joint_trajectory": name for name in self._robots}

    def start(self, goal: Goal, message: Mapping[str, Any]) -> None:
        """Start an action goal; if it is refused, abort it with the reason."""
        try:
            requests = self._request(goal, _converted(message, _Goal))
        except ArmlabError as error:
            code = _JOINTS_CODE if isinstance(error, UnknownName) else _CODES["refused"]
            self._loop.ask(Report(goal.client, str(error)))
            goal.on_result(ABORTED, code, str(error))
        else:
            self._send(goal, requests)

    def start_message(self, topic: str, client: str, message: Any, refuse: Callable[[str], None]) -> None:
        """Start a trajectory received on a topic; call `refuse` with the reason if it is aborted."""

        def on_result(status: int, code: int, text: str) -> None:
            if status == ABORTED:
                refuse(text)

        goal = Goal(client, topic.split("/")[1], token_hex(8), on_result, is_message=True)
        try:
            requests = self._request(goal, _Goal(_converted(message, _Trajectory)))
        except ArmlabError as error:
            raise CommandRefused(str(error)) from None
        self._send(goal, requests)

    def cancel(self, goals: Iterable[Goal]) -> None:
        """Bring the arms of these goals to rest."""
        for goal in goals:
            self._loop.ask(Cancel(goal.client, goal.arm, goal.name))

    def running(self, arm: str = "", client: str = "", name: str = "") -> list[Goal]:
        """Return the active goals that match the given arm, client or name."""
        found = tuple(self._goals.values())
        return [one for one in found if arm in ("", one.arm) and client in ("", one.client) and name in ("", one.name)]

    def leave(self, client: str) -> None:
        """End a disconnected client's goals and their leases."""
        for goal in self.running(client=client):
            if goal.is_message:
                self._goals.pop((client, goal.name), None)
            else:
                self._finish(goal, ABORTED, _CODES["interrupted"], "The client disconnected.")

    def text(self, message: Mapping[str, Any]) -> None:
        """Handle a "goal" message from the loop."""
        goal = self._goals.get((message["client"], message["goal"]))
        if goal is None:
            return
        if message["status"] == "executing":
            goal.is_running = True
            goal.on_status(EXECUTING)
            return
        if goal.is_message and message["ending"] == "interrupted":  # by a newer message or by the client itself
            del self._goals[goal.client, goal.name]
            return
        self._finish(goal, _STATUS[message["status"]], _CODES[message["ending"]], message["text"])

    def row(self, data: bytes, now_ns: int) -> None:
        """Renew the leases and send feedback based on a row."""
        self.renew(now_ns)
        feedback = [goal for goal in tuple(self._goals.values()) if goal.is_running and goal.on_feedback is not None]
        if not feedback:
            return
        _, mono_ns, wall_ns = read_head(self._loop.schema, data)
        for goal in feedback:
            arm = ArmRow(self._robots[goal.arm], self._places[goal.arm], data, wall_ns)
            if goal.since_ns is None:
                goal.since_ns = mono_ns
            if mono_ns >= goal.feedback_ns and arm["fresh"][0] and goal.on_feedback is not None:
                goal.feedback_ns = mono_ns + _FEEDBACK
                goal.on_feedback(_feedback(arm, goal.begin + 1e-9 * (mono_ns - goal.since_ns)))

    def renew(self, now_ns: int) -> None:
        """Renew the leases of all active goals."""
        if now_ns - self._renewed_ns >= _RENEW:
            self._renewed_ns = now_ns
            for goal in tuple(self._goals.values()):
                if goal.is_sent:  # the loop ends a goal that it has received only in part
                    self._loop.ask(Renew(goal.client, goal.arm, goal.name))

    def _send(self, goal: Goal, requests: list[TrajectoryRequest]) -> None:
        self._goals[goal.client, goal.name] = goal
        for request in requests:
            self._loop.ask(request)
        goal.is_sent = True

    def _request(self, goal: Goal, message: _Goal) -> list[TrajectoryRequest]:
        robot = self._robots[goal.arm]
        if not goal.name:
            raise CommandRefused("Expected a goal with an id, got no id. Set a goal id.")
        if (goal.client, goal.name) in self._goals or len(self._goals) >= _MOST:
            raise CommandRefused(
                f"Expected a new goal id and at most {_MOST} active goals. Wait until a goal has ended."
            )
        if message.multi_dof_trajectory.joint_names or message.component_path_tolerance:
            raise CommandRefused(
                "Expected a trajectory of single-axis joints, got joints with several degrees of freedom."
            )
        trajectory = _trajectory(message.trajectory).ordered(robot.ros_joint_names)
        trajectory.check(self._limits[goal.arm])
        stamp = message.trajectory.header.stamp.seconds
        goal.begin = time.time() - stamp if stamp else 0.0
        if not -_LONGEST_DELAY <= goal.begin <= trajectory.duration:
            raise CommandRefused(
                f"Expected a trajectory that begins within {_LONGEST_DELAY:g} s and ends in the future, got a "
                f"trajectory of {trajectory.duration:.3f} s whose header is {goal.begin:.3f} s old. Set the stamp to 0 "
                "to begin now."
            )
        path = _tolerance(message.path_tolerance, robot, Tolerance())
        end = _tolerance(message.goal_tolerance, robot, GOAL_TOLERANCE)
        seconds = message.goal_time_tolerance.seconds
        columns = [one for one in (trajectory.q, trajectory.qd, trajectory.qdd) if one is not None]
        rows = np.column_stack([trajectory.t, *columns])
        many = max(1, _PART // (8 * rows.shape[1]))
        parts = [rows[first : first + many].tobytes() for first in range(0, len(rows), many)]
        given: dict[str, Any] = {
            "count": len(parts),
            "orders": len(columns),
            "goal_time": seconds if seconds > 0.0 else GOAL_TIME,
            "begin": goal.begin,
        }
        tolerances = np.concatenate([path.spread(robot.n), end.spread(robot.n)]).tobytes()
        return [
            TrajectoryRequest(goal.client, goal.arm, goal.name, part, index=k, tolerances=tolerances, **given)
            for k, part in enumerate(parts)
        ]

    def _finish(self, goal: Goal, status: int, code: int, text: str) -> None:
        if self._goals.pop((goal.client, goal.name), None) is goal:  # only once, in the first thread that gets here
            goal.on_result(status, code, text)


def result(code: int, text: str) -> dict[str, Any]:
    """Return the fields of a FollowJointTrajectory result."""
    return {"error_code": code, "error_string": text}


def _feedback(arm: ArmRow, t: float) -> dict[str, Any]:
    """Return the fields of a FollowJointTrajectory feedback message."""
    desired, actual = ([list(arm.numbers(name)) for name in names] for names in (("q_ref", "qd_ref"), ("q", "qd")))
    error = [[a - b for a, b in zip(one, other, strict=False)] for one, other in zip(desired, actual, strict=True)]
    found: dict[str, Any] = {
        "header": {"stamp": _time(arm.wall_ns), "frame_id": ""},
        "joint_names": list(arm.robot.ros_joint_names),
    }
    for name, (q, qd) in (("desired", desired), ("actual", actual), ("error", error)):
        found[name] = {
            "positions": q,
            "velocities": qd,
            "accelerations": [],
            "effort": [],
            "time_from_start": _time(round(1e9 * max(t, 0.0))),
        }
    return found


def plain(message: Any) -> Any:
    """Convert a message of a type in `store` to dictionaries, lists and numbers."""
    if hasattr(message, "__dataclass_fields__"):
        return {name: plain(getattr(message, name)) for name in message.__dataclass_fields__ if name != "__msgtype__"}
    if isinstance(message, np.ndarray):
        return message.tolist()
    return [plain(one) for one in message] if isinstance(message, list | tuple) else message


_MESSAGES = {
    "control_msgs/msg/JointTolerance": "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration",
    "control_msgs/msg/JointComponentTolerance": (
        "string joint_name\nuint16 component\nfloat64 position\nfloat64 velocity\nfloat64 acceleration"
    ),
    f"{FOLLOW}_Goal": (
        "trajectory_msgs/JointTrajectory trajectory\n"
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory\n"
        "control_msgs/JointTolerance[] path_tolerance\n"
        "control_msgs/JointComponentTolerance[] component_path_tolerance\n"
        "control_msgs/JointTolerance[] goal_tolerance\n"
        "control_msgs/JointComponentTolerance[] component_goal_tolerance\n"
        "builtin_interfaces/Duration goal_time_tolerance"
    ),
    f"{FOLLOW}_Result": "int32 error_code\nstring error_string",
    f"{FOLLOW}_Feedback": (
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint desired\n"
        "trajectory_msgs/JointTrajectoryPoint actual\n"
        "trajectory_msgs/JointTrajectoryPoint error\n"
        "string[] multi_dof_joint_names\n"
        "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired\n"
        "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual\n"
        "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error"
    ),
    f"{FOLLOW}_FeedbackMessage": f"unique_identifier_msgs/UUID goal_id\n{FOLLOW}_Feedback feedback",
}
_SERVICES = {
    f"{FOLLOW}_SendGoal": (
        f"unique_identifier_msgs/UUID goal_id\n{FOLLOW}_Goal goal",
        "bool accepted\nbuiltin_interfaces/Time stamp",
    ),
    f"{FOLLOW}_GetResult": ("unique_identifier_msgs/UUID goal_id", f"int8 status\n{FOLLOW}_Result result"),
    CANCEL: ("action_msgs/GoalInfo goal_info", "int8 return_code\naction_msgs/GoalInfo[] goals_canceling"),
}
_REJECTED, _UNKNOWN, _TERMINATED = 1, 2, 3  # return codes of a cancellation
_KEPT = 64  # maximum number of ended goals per action whose results can be requested


@dataclass
class _Record:
    """Action goal with its status, its result and the pending requests for the result."""

    id: bytes
    goal: Goal
    stamp_ns: int  # time of acceptance
    status: int = ACCEPTED
    result: dict[str, Any] = field(default_factory=dict)
    waiting: list[Respond] = field(default_factory=list)

    @property
    def info(self) -> dict[str, Any]:
        return {"goal_id": {"uuid": self.id}, "stamp": _time(self.stamp_ns)}


class ActionServers:
    """Action servers of all arms: services, feedback and status; `publish` sends a message with a type from `store`."""

    def __init__(self, goals: Goals, publish: Callable[[RosTopic, Any], None], wanted: Callable[[], Collection[str]]):
        _register()
        self._goals, self._publish, self._wanted = goals, publish, wanted
        self._records: dict[str, dict[bytes, _Record]] = {name: {} for name in goals.actions}
        self._lock = threading.RLock()
        self.services: list[Service] = []
        self.topics: dict[str, RosTopic] = {}
        self.latched: list[str] = [f"{name}/_action/status" for name in goals.actions]
        for name in goals.actions:
            for part, type_, answer in (
                ("send_goal", f"{FOLLOW}_SendGoal", self._send_goal),
                ("get_result", f"{FOLLOW}_GetResult", self._get_result),
                ("cancel_goal", CANCEL, self._cancel_goal),
            ):
                self.services.append(Service(f"{name}/_action/{part}", type_, partial(answer, name)))
            for part, type_ in (("feedback", f"{FOLLOW}_FeedbackMessage"), ("status", STATUS)):
                self.topics[f"{name}/_action/{part}"] = RosTopic(f"{name}/_action/{part}", type_)

    def _send_goal(self, action: str, request: Any, client: str, respond: Respond) -> None:
        id_, records = bytes(request.goal_id.uuid), self._records[action]
        with self._lock:
            is_new, stamp_ns = id_ not in records, time.time_ns()
            goal = Goal(client, self._goals.actions[action], id_.hex(), partial(self._finish, action, id_))
            goal.on_feedback, goal.on_status = partial(self._feedback, action, id_), partial(self._status, action, id_)
            if is_new:
                records[id_] = _Record(id_, goal, stamp_ns)
                ended = [key for key, one in records.items() if one.result]
                for key in ended[: max(0, len(ended) - _KEPT)]:
                    del records[key]
            respond(message(f"{FOLLOW}_SendGoal_Response", {"accepted": is_new, "stamp": _time(stamp_ns)}))
            if is_new:
                self._status(action, id_, ACCEPTED)
        if is_new:
            self._goals.start(goal, plain(request.goal))

    def _get_result(self, action: str, request: Any, client: str, respond: Respond) -> None:
        with self._lock:
            record = self._records[action].get(bytes(request.goal_id.uuid))
            if record is not None and not record.result:
                record.waiting.append(respond)
            else:
                status, values = (0, {}) if record is None else (record.status, record.result)
                respond(message(f"{FOLLOW}_GetResult_Response", {"status": status, "result": values}))

    def _cancel_goal(self, action: str, request: Any, client: str, respond: Respond) -> None:
        """Cancel one goal, all goals accepted until a time, or all goals; an id or time of zero matches any."""
        info, records = request.goal_info, self._records[action]
        id_, until_ns = bytes(info.goal_id.uuid), 1_000_000_000 * info.stamp.sec + info.stamp.nanosec
        with self._lock:
            named = records.get(id_)
            found = [] if named is None else [named]
            if until_ns or not any(id_):
                found += [one for one in records.values() if not until_ns or one.stamp_ns <= until_ns]
            running = [one for one in {one.id: one for one in found}.values() if not one.result]
            code = 0 if running else _TERMINATED if named else _UNKNOWN if any(id_) else _REJECTED
            for one in running:
                self._status(action, one.id, CANCELING)
            values = {"return_code": code, "goals_canceling": [one.info for one in running]}
            respond(message(f"{CANCEL}_Response", values))
        self._goals.cancel([one.goal for one in running])

    def _finish(self, action: str, id_: bytes, status: int, code: int, text: str) -> None:
        with self._lock:
            record = self._records[action][id_]
            record.result, waiting = result(code, text), [*record.waiting]
            record.waiting.clear()
            self._status(action, id_, status)
        for respond in waiting:  # without holding the lock, because a responding transport has its own lock
            respond(message(f"{FOLLOW}_GetResult_Response", {"status": status, "result": record.result}))

    def _status(self, action: str, id_: bytes, status: int) -> None:
        """Publish the status of all goals."""
        with self._lock:
            records = self._records[action]
            record = records.get(id_)
            if record is None or (record.result and status < SUCCEEDED):
                return
            record.status = status
            shown = [{"goal_info": one.info, "status": one.status} for one in records.values()]
            self._publish(self.topics[f"{action}/_action/status"], message(STATUS, {"status_list": shown}))

    def _feedback(self, action: str, id_: bytes, values: dict[str, Any]) -> None:
        topic = self.topics[f"{action}/_action/feedback"]
        if topic.name in self._wanted():
            self._publish(topic, message(topic.type, {"goal_id": {"uuid": id_}, "feedback": values}))


@cache
def _register() -> None:
    """Register the action types in `store`."""
    for name, text in _MESSAGES.items():
        store().register(get_types_from_msg(text, name))
    register(_SERVICES)


def _time(ns: int) -> dict[str, int]:
    return dict(zip(("sec", "nanosec"), divmod(ns, 1_000_000_000), strict=True))


_EMPTY: dict[str, Any] = {"string": "", "bool": False, "float64": 0.0}


def message(type_: str, values: Mapping[str, Any]) -> Any:
    """Build a message of a type in `store` from dictionaries, lists and numbers; missing fields are zero or empty."""
    found = {}
    for name, (kind, about) in store().fielddefs[type_][1]:
        if kind == Nodetype.NAME:
            found[name] = message(about, values.get(name, {}))
        elif kind == Nodetype.BASE:
            found[name] = values.get(name, _EMPTY.get(about[0], 0))
        elif about[0][0] == Nodetype.NAME:
            found[name] = [message(about[0][1], one) for one in values.get(name, ())]
        elif about[0][1][0] == "string":
            found[name] = list(values.get(name, ()))
        else:
            given = values.get(name, bytes(about[1]) if kind == Nodetype.ARRAY else ())
            found[name] = np.array([*given], dtype=about[0][1][0])
    return store().types[type_](**found)
