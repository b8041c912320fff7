"""ROS 1 node of `Ros1Process`: a program for the system's Python (3.6 or later) that needs only rospy.

Standard input and output share one message socket, which carries JSON objects. The first input contains "node" and, in
"published" and "taken", the types by topic. Later inputs contain a "text" for the ROS log, or the "topic" and "id" of a
connection to close. Every output has a "kind". The first is "ready"; later outputs are "command" ("refused" if too
long), or "subscriber" with the connection of a topic's subscriber. rospy negotiates the connection, and the bridge
writes the messages. The program exits when its input closes, or with an error message when the master disappears.
"""

import array
import contextlib
import importlib
import json
import os
import socket
import sys
import threading
from pathlib import Path

_LARGEST = 2**17
_COMMAND = 65536  # maximum size of a command in bytes, as for a request to the loop
_NAME = 256  # maximum length of a node name, which the node chooses
_CHECK_EVERY = 0.5  # s between checks of the master
_PATIENCE = 3.0  # s for the master to answer


def main() -> int:
    sys.path[:] = [one for one in sys.path if Path(one).resolve() != Path(__file__).parent]  # hides process.py
    pipe = socket.socket(fileno=os.dup(0))
    os.dup2(2, 1)  # rospy prints to standard output
    try:
        rospy, rosgraph = importlib.import_module("rospy"), importlib.import_module("rosgraph")
    except ImportError as error:
        return _fail(f"Expected rospy under {sys.executable}, got {error}. Install python3-rospy.")
    wrong = _listen_at(os.environ["ROS_IP"], rosgraph.network)
    if wrong:
        return _fail(wrong)
    socket.setdefaulttimeout(_PATIENCE)
    master = rosgraph.Master("/armlab")
    first = _number(master)
    if first is None:
        return _fail(f"Expected a ROS master at {master.master_uri}, got no answer. Start roscore.")
    socket.setdefaulttimeout(None)  # otherwise it would apply to all rospy sockets
    about = json.loads(pipe.recv(_LARGEST).decode())
    rospy.init_node(about["node"], disable_signals=True)
    threading.Thread(target=_watch, args=(master, first), daemon=True).start()
    _Node(rospy, pipe, about).run()
    rospy.signal_shutdown("the bridge has ended")
    return 0


class _Node:
    """Publishers and subscribers of the node; handles messages from the bridge."""

    def __init__(self, rospy, pipe, about):
        self._rospy, self._pipe = rospy, pipe
        self._lock, self._handed = threading.Lock(), {}
        listener = self._listener()
        types = {name: _type(name) for name in {*about["published"].values(), *about["taken"].values()}}
        self._publishers = {  # rospy only accepts connections; the bridge writes the messages
            topic: rospy.Publisher(topic, types[name], queue_size=1)
            for topic, name in about["published"].items()
            if types[name] is not None
        }
        self._send(kind="ready", missing=sorted(name for name, kind in types.items() if kind is None))
        self._subscribers = [  # callbacks may start immediately, in other threads
            rospy.Subscriber(topic, types[name], self._take, topic, queue_size=1, tcp_nodelay=True)
            for topic, name in about["taken"].items()
            if types[name] is not None
        ]
        for publisher in self._publishers.values():
            publisher.impl.add_subscriber_listener(listener)
            self._hand_over(publisher)  # subscribers that connected earlier

    def run(self):
        """Handle messages from the bridge until the input closes: texts to log, and connections to close."""
        while True:
            data = self._pipe.recv(_LARGEST)
            if not data:
                return
            message = json.loads(data.decode())
            if "text" in message:
                self._rospy.logwarn(message["text"])
            else:
                for one in self._publishers[message["topic"]].impl.connections:
                    if one.id == message["id"]:
                        _end(one)

    def _listener(self):
        node = self

        class Listener(self._rospy.SubscribeListener):
            def peer_subscribe(self, topic, publish, publish_single):
                node._hand_over(node._publishers[topic])

        return Listener()

    def _hand_over(self, publisher):
        """Pass new connections for a topic to the bridge."""
        with self._lock:
            name = publisher.resolved_name
            before = self._handed.get(name, ())
            connections = publisher.impl.connections
            self._handed[name] = {one.id for one in connections if one.id in before or self._hand(name, one)}

    def _hand(self, name, one):
        message = {"kind": "subscriber", "topic": name, "client": one.endpoint_id[:_NAME], "id": one.id}
        try:
            number = array.array("i", [one.socket.fileno()])
            self._pipe.sendmsg([json.dumps(message).encode()], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, number)])
        except (AttributeError, OSError):  # closed, or refused by the system; end it, or the node would wait forever
            _end(one)
            return False
        return True

    def _take(self, message, topic):
        content = getattr(message, "data", None)
        content = list(content) if isinstance(content, (list, tuple)) else content
        client = message._connection_header.get("callerid", "?")[:_NAME]
        size = self._send(kind="command", topic=topic, client=client, content=content)
        if size > _COMMAND:
            text = f"Expected at most {_COMMAND} bytes of JSON on {topic}, got {size}. Send a smaller message."
            self._send(kind="refused", client=client, text=text)

    def _send(self, **fields):
        """Send a message to the bridge unless it is too long; return its size in bytes."""
        data = json.dumps(fields).encode()
        if len(data) <= _COMMAND:
            with contextlib.suppress(OSError):  # the bridge is not reading; newer commands will follow
                self._pipe.send(data, socket.MSG_DONTWAIT)
        return len(data)


def _end(connection):
    with contextlib.suppress(AttributeError, OSError):  # already closed
        connection.socket.shutdown(socket.SHUT_RDWR)


def _type(name):
    package, _, kind = name.partition("/")
    try:
        return getattr(importlib.import_module(package + ".msg"), kind)
    except (ImportError, AttributeError):
        return None


def _listen_at(host, network):
    """Make rospy listen on only one address; return "" or an error message."""
    try:
        with contextlib.closing(socket.socket()) as probe:
            probe.bind((host, 0))
    except OSError as error:
        return (
            f"Expected an address of this computer for ros1, got {host}: "
            f"{error.strerror}. Pass one of this computer's addresses."
        )
    network.get_bind_address = lambda address=None: host
    return ""


def _number(master):
    """Return the master's process id, which changes when it restarts, or None if it does not answer."""
    try:
        return master.getPid()
    except Exception:  # from XML-RPC, HTTP or the socket
        return None


def _watch(master, first):
    """Exit when the master disappears or restarts, because nodes do not re-register by themselves."""
    over = threading.Event()
    while not over.wait(_CHECK_EVERY):
        if _number(master) != first:
            _fail(f"Expected the ROS master at {master.master_uri} to keep running, but it stopped or restarted.")
            os._exit(1)


def _fail(sentence):
    sys.stderr.write(sentence + "\n")
    sys.stderr.flush()
    return 1


if __name__ == "__main__":
    sys.exit(main())
