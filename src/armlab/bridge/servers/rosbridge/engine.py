"""`Engine`: rosbridge v2 without sockets; converts client operations to loop requests, and rows to messages."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import msgspec

from armlab.bridge.servers.messages import CommandRequest, Leave, Report, SetRequest
from armlab.bridge.servers.ros.actions import FOLLOW, Goal, Goals, result
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.services import Settings
from armlab.bridge.servers.ros.topics import Messages, RosTopic, Topics
from armlab.bridge.servers.rosbridge import protocol
from armlab.bridge.servers.rosbridge.protocol import Dialect, Level, Rosapi, full_name, parameter_name
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import CommandRefused, UnknownName

_KEPT = 1_000_000_000  # ns, maximum age of a queued message
_PATIENCE = 10_000_000_000  # ns without progress after which a client is disconnected
_LARGEST = 4 * 2**20  # maximum bytes queued


class _Waiting(NamedTuple):
    """Queued message with its time and topic."""

    ns: int
    topic: str
    data: bytes


class Outbox:
    """Message queue of one client."""

    sent: int = 0
    dropped: int = 0

    def __init__(self) -> None:
        self._waiting: deque[_Waiting] = deque()
        self._of_topic: Counter[str] = Counter()
        self._bytes = 0
        self._since_ns: int | None = None

    def put(self, data: bytes, now_ns: int, topic: str = "", most: int = 0) -> None:
        """Queue a message; drop messages older than 1 s."""
        if self._since_ns is None:
            self._since_ns = now_ns
        while self._waiting and (now_ns - self._waiting[0].ns > _KEPT or self._bytes + len(data) > _LARGEST):
            self._drop(0)
        if most and self._of_topic[topic] >= most:
            self._drop(next(k for k, one in enumerate(self._waiting) if one.topic == topic))
        self._waiting.append(_Waiting(now_ns, topic, data))
        self._of_topic[topic] += 1
        self._bytes += len(data)

    def take(self, most: int) -> list[bytes]:
        """Return the next messages for a client that is ready to read."""
        self._since_ns = None
        found: list[bytes] = []
        while self._waiting and most > 0:
            found.append(self._remove(0).data)
            most -= len(found[-1])
        self.sent += len(found)
        return found

    def is_stuck(self, now_ns: int) -> bool:
        """Return whether the client has left waiting messages unread for 10 s."""
        return self._since_ns is not None and now_ns - self._since_ns > _PATIENCE

    def _drop(self, k: int) -> None:
        self._remove(k)
        self.dropped += 1

    def _remove(self, k: int) -> _Waiting:
        one = self._waiting[k]
        del self._waiting[k]
        self._of_topic[one.topic] -= 1
        self._bytes -= len(one.data)
        return one


_IDS = 16  # maximum number of ids per topic; a client with more ids is faulty


class Subscription:
    """Subscription of one client to one topic, at the highest rate requested by any of its subscription ids."""

    topic: str
    full_name: str

    def __init__(self, topic: str, outbox: Outbox, dialect: Dialect) -> None:
        self.dialect: Dialect = dialect
        self.topic, self.full_name, self._outbox = topic, full_name(topic), outbox
        self._ids: dict[str, tuple[int, int]] = {}
        self._waiting: deque[bytes] = deque()
        self._every_ns = self._most = self._due_ns = 0

    def add(self, id_: str, throttle_ms: float, queue_length: int) -> None:
        """Add a subscription id, or change its settings."""
        self._ids[id_] = (int(1e6 * throttle_ms), queue_length)
        while len(self._ids) > _IDS:
            del self._ids[next(iter(self._ids))]
        self._agree()

    def remove(self, id_: str | None) -> bool:
        """Remove one id (None: all ids); return whether the subscription has ended."""
        if id_ is None:
            self._ids.clear()
        self._ids.pop(id_ or "", None)
        self._agree()
        return not self._ids

    def is_due(self, now_ns: int) -> bool:
        """Send a queued message if due; return whether a new message would now be sent or queued rather than
        dropped."""
        if self._waiting and now_ns >= self._due_ns:
            self._send(self._waiting.popleft(), now_ns)
        return self._most > 0 or now_ns >= self._due_ns

    def offer(self, data: bytes, now_ns: int) -> None:
        """Send, queue or drop a message."""
        if now_ns >= self._due_ns and not self._waiting:
            self._send(data, now_ns)
        elif self._most:
            self._waiting.append(data)
            while len(self._waiting) > self._most:
                self._waiting.popleft()
                self._outbox.dropped += 1

    def _send(self, data: bytes, now_ns: int) -> None:
        self._due_ns = now_ns + self._every_ns
        self._outbox.put(data, now_ns, self.topic, 0 if self._every_ns else self._most)

    def _agree(self) -> None:
        self._every_ns = min((every for every, _ in self._ids.values()), default=0)
        self._most = min((most for _, most in self._ids.values()), default=0)


_LEVELS = ("info", "warning", "error", "none")


class ClientSession:
    """State of one client."""

    name: str
    may_ask: bool

    def __init__(self, name: str, may_ask: bool) -> None:
        self.name, self.may_ask = name, may_ask
        self.outbox: Outbox = Outbox()
        self.subscriptions: dict[str, Subscription] = {}
        self.advertised: set[str] = set()
        self.warned: set[str] = set()
        self.level: Level = "error"  # lowest level of status messages sent

    def status(self, level: Level, text: str, now_ns: int, id_: str | int | None = None) -> None:
        """Send the client a status message unless it is below the client's level."""
        if _LEVELS.index(level) >= _LEVELS.index(self.level):
            about = {} if id_ is None else {"id": id_}
            self._send({"op": "status", **about, "level": level, "msg": text}, now_ns)

    def response(self, service: str, id_: str | int | None, values: Any, is_done: bool, now_ns: int) -> None:
        about = {} if id_ is None else {"id": id_}
        message = {"op": "service_response", **about, "service": service, "values": values, "result": is_done}
        self._send(message, now_ns)

    def action(self, op: str, action: str, id_: str, values: Any, **more: Any) -> None:
        """Send the feedback or the result of a goal."""
        message = {"op": op, "id": id_, "action": action, "values": values, **more}
        self._send(message, time.monotonic_ns())

    def _send(self, message: dict[str, Any], now_ns: int) -> None:
        self.outbox.put(msgspec.json.encode(message), now_ns)


_ABSENT: Mapping[str, Any] = {"std_msgs/msg/Float64MultiArray": [], "std_msgs/msg/String": ""}


class Engine:
    """Executes the operations of all clients and sends them messages."""

    def __init__(self, loop: LoopEnd, dialect: Dialect = "ros2") -> None:
        robots = loop.robots()
        self._dialect: Dialect = dialect
        self._loop, self._settings, self._now_ns = loop, Settings(loop), 0
        self._topics, self._commands = Topics(robots, loop.schema), Commands(loop.about["cell"], robots)
        self._published = self._topics.published
        types = {name: one.type for name, one in self._published.items()} | self._commands.types
        self._goals = Goals(loop)
        types |= self._goals.topics
        actions = dict.fromkeys(self._goals.actions, FOLLOW)
        self._rosapi = Rosapi(loop.about["cell"], types, lambda: self._loop.parameters, actions)
        self._numbers: Counter[str] = Counter()
        self.sessions: dict[str, ClientSession] = {}

    def join(self, name: str, may_ask: bool = True) -> ClientSession:
        session = self.sessions[name] = ClientSession(name, may_ask)
        return session

    def leave(self, session: ClientSession) -> None:
        del self.sessions[session.name]
        self._goals.leave(session.name)
        self._loop.ask(Leave(session.name))

    def take(self, session: ClientSession, data: bytes | str, now_ns: int) -> None:
        """Execute a client operation; report errors in a status message."""
        self._now_ns, operation = now_ns, None
        try:
            operation = protocol.read_operation(data)
            self._do(session, operation)
        except (CommandRefused, UnknownName) as error:
            session.status("error", str(error), now_ns, protocol.id_of(data) if operation is None else operation.id)
            self._loop.ask(Report(session.name, str(error)))

    def row(self, data: bytes, now_ns: int) -> None:
        self._publish(lambda wanted: self._topics.of_row(data, wanted.keys()), now_ns)
        self._goals.row(data, now_ns)

    def text(self, message: Mapping[str, Any], now_ns: int) -> None:
        """Handle a message from the loop that is not a row."""
        self._now_ns = now_ns
        if message["kind"] == "parameters":
            self._publish(lambda wanted: self._topics.of_parameters(self._loop.parameters, wanted), now_ns)
            self._settings.confirm()
        elif message["kind"] == "goal":
            self._goals.text(message)
        elif message["kind"] == "answer" and not self._settings.refuse(message):
            session, text = self.sessions.get(message["client"]), message["text"]
            if session is not None:
                session.status("info" if text == "Done." else "error", text, now_ns)

    def tick(self, now_ns: int) -> None:
        """Handle timeouts and send messages that are due while no rows arrive; called ten times per second."""
        self._publish(lambda wanted: self._topics.of_silence(now_ns, wanted.keys()), now_ns)
        self._goals.renew(now_ns)
        self._now_ns = now_ns
        self._settings.tick(now_ns)

    def _do(self, session: ClientSession, operation: protocol.Operation) -> None:
        match operation:
            case protocol.Publish():
                self._take_message(session, operation)
            case protocol.SubscribeOperation():
                self._subscribe(session, operation)
            case protocol.Unsubscribe():
                name = operation.topic
                if name in session.subscriptions and session.subscriptions[name].remove(_id(operation)):
                    del session.subscriptions[name]
            case protocol.Advertise():
                name = full_name(operation.topic)
                known = self._commands.types | self._goals.topics
                self._known(name, operation.type, known, "command topic of this cell")
                session.advertised.add(name)
            case protocol.Unadvertise():
                session.advertised.discard(full_name(operation.topic))
            case protocol.SendActionGoal():
                self._start(session, operation)
            case protocol.CancelActionGoal():
                self._goals.cancel(self._goals.running(client=session.name, name=str(operation.id)))
            case protocol.CallService():
                self._call(session, operation)
            case protocol.SetLevel():
                session.level = operation.level
            case protocol.ServiceResponse():
                raise CommandRefused("Expected no service_response, because the bridge calls no client services.")
            case protocol.StatusOperation():
                pass

    def _subscribe(self, session: ClientSession, operation: protocol.SubscribeOperation) -> None:
        name = operation.topic
        types = {topic: one.type for topic, one in self._published.items()}
        dialect = self._known(full_name(name), operation.type, types, "topic")
        if operation.compression not in (None, "", "none"):
            raise CommandRefused(f"Expected no compression, got {operation.compression[:80]!r}. Omit it.")
        if operation.fragment_size is not None:
            raise CommandRefused("Expected no fragment_size, because messages are not fragmented.")
        known = session.subscriptions.get(name)
        if known is None or known.dialect != dialect:
            known = session.subscriptions[name] = Subscription(name, session.outbox, dialect)
        known.add(_id(operation) or "", operation.throttle_rate or 0.0, operation.queue_length or 0)
        kept = [one for one in self._topics.latched.values() if one[0].name == known.full_name]
        for published, message in (*kept, *self._topics.of_parameters(self._loop.parameters, {known.full_name})):
            self._send(published, message, [known], self._now_ns)

    def _known(self, topic: str, type_: str | None, types: Mapping[str, str], what: str) -> Dialect:
        """Return the dialect that a client uses for a topic; the given type must match the topic."""
        if topic not in types:
            raise UnknownName.among(what, topic, types)
        if not type_:
            return self._dialect
        wanted, dialect = protocol.read_type(type_)
        if wanted != types[topic]:
            raise CommandRefused(f"Expected {protocol.type_name(types[topic], dialect)} for {topic}, got {type_}.")
        return dialect

    def _take_message(self, session: ClientSession, operation: protocol.Publish) -> None:
        name, types = full_name(operation.topic), self._commands.types
        if name in self._goals.topics:
            _check_rights(session)
            refuse = partial(self._refuse, session, operation.id)
            self._goals.start_message(name, session.name, operation.msg, refuse)
            return
        if name not in types:
            raise UnknownName.among("command topic of this cell", name, types)
        missing = [field for field in protocol.fields(types[name]) if field not in operation.msg]
        if missing and name not in session.warned:
            session.warned.add(name)
            text = f"Expected {', '.join(missing)} in {types[name]} on {name}, got none. The default applies."
            session.status("warning", text, self._now_ns, operation.id)
        content = operation.msg.get("data", _ABSENT.get(types[name]))
        for request in self._commands.requests(name, content, session.name):
            if isinstance(request, CommandRequest | SetRequest):
                _check_rights(session)
            self._loop.ask(request)

    def _refuse(self, session: ClientSession, id_: str | int | None, why: str) -> None:
        session.status("error", why, time.monotonic_ns(), id_)

    def _start(self, session: ClientSession, operation: protocol.SendActionGoal) -> None:
        """Start an action goal; if it is refused, the result contains the reason."""
        action, id_, actions = operation.action, str(operation.id), self._goals.actions

        def on_result(status: int, code: int, text: str) -> None:
            session.action("action_result", action, id_, result(code, text), status=status, result=True)

        def on_feedback(values: dict[str, Any]) -> None:
            session.action("action_feedback", action, id_, values)

        try:
            if full_name(action) not in actions:
                raise UnknownName.among("action", action[:80], actions)
            if operation.action_type not in (None, FOLLOW, FOLLOW.replace("/action/", "/")):
                raise CommandRefused(f"Expected {FOLLOW} for {action}, got {operation.action_type}.")
            _check_rights(session)
        except (CommandRefused, UnknownName) as error:
            session.action("action_result", action, id_, str(error), status=0, result=False)
            self._loop.ask(Report(session.name, str(error)))
            return
        goal = Goal(session.name, actions[full_name(action)], id_, on_result)
        goal.on_feedback = on_feedback if operation.feedback else None
        self._goals.start(goal, operation.args)

    def _call(self, session: ClientSession, call: protocol.CallService) -> None:
        dialect: Dialect = self._dialect
        if call.type:
            dialect = "ros2" if call.type.count("/") == 2 else "ros1"
        arm = self._goals.actions.get(full_name(call.service).removesuffix(protocol.CANCEL))
        if arm is not None:
            self._goals.cancel(self._goals.running(arm=arm))
            canceled = {"return_code": 0, "goals_canceling": []}
            session.response(call.service, call.id, canceled, True, self._now_ns)
            return
        try:
            given = self._rosapi.arguments(call.service, call.args)
            if full_name(call.service) == protocol.SET_PARAM:
                self._set(session, call, given)
                return
            values, is_done = self._rosapi.answer(call.service, given, dialect), True
        except (CommandRefused, UnknownName) as error:
            values, is_done = str(error), False
        session.response(call.service, call.id, values, is_done, self._now_ns)

    def _set(self, session: ClientSession, call: protocol.CallService, given: Mapping[str, Any]) -> None:
        """Ask the loop to set a value; the loop answers later."""
        _check_rights(session)
        name = parameter_name(given, self._loop.parameters)
        try:
            value = msgspec.json.decode(str(given.get("value")))
        except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
            raise CommandRefused(f"Expected the value of {name} as JSON text, got {error}.") from None

        def done(why: str) -> None:
            session.response(call.service, call.id, why or {}, not why, self._now_ns)

        self._settings.set(session.name, {name: value}, done, self._now_ns)

    def _publish(self, made: Callable[[Mapping[str, Any]], Messages], now_ns: int) -> None:
        wanted: dict[str, list[Subscription]] = {}
        for session in self.sessions.values():
            for one in session.subscriptions.values():
                if one.is_due(now_ns):
                    wanted.setdefault(one.full_name, []).append(one)
        for published, message in made(wanted):
            self._send(published, message, wanted[published.name], now_ns)

    def _send(self, topic: RosTopic, message: Any, to: Iterable[Subscription], now_ns: int) -> None:
        """Send a message as JSON, encoded once per dialect and topic spelling."""
        self._numbers[topic.name] += 1
        texts: dict[tuple[str, Dialect], bytes] = {}
        for one in to:
            kind = one.topic, one.dialect
            if kind not in texts:
                texts[kind] = protocol.publish(one.topic, message, topic.type, one.dialect, self._numbers[topic.name])
            one.offer(texts[kind], now_ns)


def _id(operation: protocol.SubscribeOperation | protocol.Unsubscribe) -> str | None:
    return None if operation.id is None else str(operation.id)


def _check_rights(session: ClientSession) -> None:
    if not session.may_ask:
        raise CommandRefused("Expected a token for commands and settings, got none. Send Authorization: Bearer TOKEN.")
