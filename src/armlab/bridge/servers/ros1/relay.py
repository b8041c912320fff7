"""The node of `Ros1Process`: a program for the system's Python (3.6 or newer), of which it needs rospy and no more.

Standard input and output are one socket that keeps messages whole, JSON objects. In: first "node", and "published" and
"taken" types by topic; then each time a "text" for the log of ROS, or "topic" and "id" of a connection to end. Out, by
"kind": "ready" first; "command", or "refused" when it is too long; "subscriber" of a topic, with its connection: rospy
negotiates, and what is published the bridge itself writes there. It ends with its input, and with a sentence on
standard error when the master goes.
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
_COMMAND = 65536  # bytes of a command, as of a request to the loop
_NAME = 256  # characters of a node's name, which it says itself
_LOOK = 0.5  # s between two looks whether the master is still the same
_PATIENCE = 3.0  # s for the master to answer


def main() -> int:
    sys.path[:] = [one for one in sys.path if Path(one).resolve() != Path(__file__).parent]  # process.py is no module
    pipe = socket.socket(fileno=os.dup(0))
    os.dup2(2, 1)  # rospy prints
    try:
        rospy, rosgraph = importlib.import_module("rospy"), importlib.import_module("rosgraph")
    except ImportError as error:
        return _fail(f"Expected rospy under {sys.executable}, but {error}. Install python3-rospy.")
    wrong = _listen_at(os.environ["ROS_IP"], rosgraph.network)
    if wrong:
        return _fail(wrong)
    socket.setdefaulttimeout(_PATIENCE)
    master = rosgraph.Master("/armlab")
    first = _number(master)
    if first is None:
        return _fail(f"Expected a ROS master at {master.master_uri}, but none answers. Start roscore.")
    socket.setdefaulttimeout(None)  # it would hold for all sockets of rospy
    about = json.loads(pipe.recv(_LARGEST).decode())
    rospy.init_node(about["node"], disable_signals=True)
    threading.Thread(target=_watch, args=(master, first), daemon=True).start()
    _Node(rospy, pipe, about).run()
    rospy.signal_shutdown("the bridge has ended")
    return 0


class _Node:
    """Publishers and subscribers, and what comes of the bridge."""

    def __init__(self, rospy, pipe, about):
        self._rospy, self._pipe = rospy, pipe
        self._lock, self._handed = threading.Lock(), {}
        listener = self._listener()
        types = {name: _type(name) for name in {*about["published"].values(), *about["taken"].values()}}
        self._publishers = {  # nothing is published here
            topic: rospy.Publisher(topic, types[name], queue_size=1)
            for topic, name in about["published"].items()
            if types[name] is not None
        }
        self._say(kind="ready", missing=sorted(name for name, kind in types.items() if kind is None))
        self._subscribers = [  # each may call at once, in another thread
            rospy.Subscriber(topic, types[name], self._take, topic, queue_size=1, tcp_nodelay=True)
            for topic, name in about["taken"].items()
            if types[name] is not None
        ]
        for publisher in self._publishers.values():
            publisher.impl.add_subscriber_listener(listener)
            self._hand_over(publisher)  # who came before

    def run(self):
        """Do what comes until the input ends: write into the log of ROS, end connections."""
        while True:
            data = self._pipe.recv(_LARGEST)
            if not data:
                return
            said = json.loads(data.decode())
            if "text" in said:
                self._rospy.logwarn(said["text"])
            else:
                for one in self._publishers[said["topic"]].impl.connections:
                    if one.id == said["id"]:
                        _end(one)

    def _listener(self):
        node = self

        class Listener(self._rospy.SubscribeListener):
            def peer_subscribe(self, topic, publish, publish_single):
                node._hand_over(node._publishers[topic])

        return Listener()

    def _hand_over(self, publisher):
        """Give the bridge the connections of a topic that it has not."""
        with self._lock:
            name = publisher.resolved_name
            before = self._handed.get(name, ())
            connections = publisher.impl.connections
            self._handed[name] = {one.id for one in connections if one.id in before or self._hand(name, one)}

    def _hand(self, name, one):
        said = {"kind": "subscriber", "topic": name, "client": one.endpoint_id[:_NAME], "id": one.id}
        try:
            number = array.array("i", [one.socket.fileno()])
            self._pipe.sendmsg([json.dumps(said).encode()], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, number)])
        except (AttributeError, OSError):  # it has gone, or the system refuses: the node would wait for ever
            _end(one)
            return False
        return True

    def _take(self, message, topic):
        content = getattr(message, "data", None)
        content = list(content) if isinstance(content, (list, tuple)) else content
        client = message._connection_header.get("callerid", "?")[:_NAME]
        size = self._say(kind="command", topic=topic, client=client, content=content)
        if size > _COMMAND:
            text = f"Expected at most {_COMMAND} bytes of JSON on {topic}, got {size}. Send less."
            self._say(kind="refused", client=client, text=text)

    def _say(self, **fields):
        """Send to the bridge what is not too long; return its size in bytes."""
        data = json.dumps(fields).encode()
        if len(data) <= _COMMAND:
            with contextlib.suppress(OSError):  # the bridge does not read, a newer command follows; or it has gone
                self._pipe.send(data, socket.MSG_DONTWAIT)
        return len(data)


def _end(connection):
    with contextlib.suppress(AttributeError, OSError):  # it has gone
        connection.socket.shutdown(socket.SHUT_RDWR)


def _type(name):
    package, _, kind = name.partition("/")
    try:
        return getattr(importlib.import_module(package + ".msg"), kind)
    except (ImportError, AttributeError):
        return None


def _listen_at(host, network):
    """Have rospy listen at one address, by itself it takes all but for loopback; return a sentence if that fails."""
    try:
        with contextlib.closing(socket.socket()) as probe:
            probe.bind((host, 0))
    except OSError as error:
        return f"Expected an address of this computer for ros1, got {host}: {error.strerror}. Name one that it has."
    network.get_bind_address = lambda address=None: host
    return ""


def _number(master):
    """Return the process of the master, None without an answer: it changes with a restart."""
    try:
        return master.getPid()
    except Exception:  # of XML-RPC, HTTP or the socket
        return None


def _watch(master, first):
    """End the program when the master goes or is another one: nodes do not register again by themselves."""
    over = threading.Event()
    while not over.wait(_LOOK):
        if _number(master) != first:
            _fail(f"Expected the ROS master at {master.master_uri} to go on, but it has gone or is another one.")
            os._exit(1)


def _fail(sentence):
    sys.stderr.write(sentence + "\n")
    sys.stderr.flush()
    return 1


if __name__ == "__main__":
    sys.exit(main())
