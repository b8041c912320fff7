"""The node of `Ros1Process`: a program for the system's Python (3.6 or newer), of which it needs rospy and no more.

Standard input and output are one socket that keeps messages whole. In: first a JSON object with "node", and "published"
and "taken" types by topic; then sentences for the log of ROS. Out: JSON objects by "kind": "ready", "command", and
"subscriber" of a topic, with its connection: rospy negotiates, and what is published the bridge itself writes there. It
ends with its input, and with a sentence on standard error when the master goes.
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

__all__ = ["main"]

_LARGEST = 2**17
_LOOK = 0.5  # s between two looks whether the master is still the same
_PATIENCE = 3.0  # s for the master to answer


def main() -> int:
    """Run the node until the input ends; return the status of the program."""
    sys.path[:] = [one for one in sys.path if Path(one).resolve() != Path(__file__).parent]  # process.py is no module
    pipe = socket.socket(fileno=os.dup(0))
    os.dup2(2, 1)  # rospy prints
    try:
        rospy, rosgraph = importlib.import_module("rospy"), importlib.import_module("rosgraph")
    except ImportError as error:
        return _fail(f"Expected rospy under {sys.executable}, but {error}. Install python3-rospy.")
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
        listener, missing = self._listener(), set()
        self._publishers, self._subscribers = {}, []
        for topic, name in about["published"].items():
            kind = _type(name)
            if kind is None:
                missing.add(name)
            else:
                self._publishers[topic] = rospy.Publisher(topic, kind, queue_size=1)  # nothing is published here
        for topic, name in about["taken"].items():
            kind = _type(name)
            if kind is None:
                missing.add(name)
            else:
                taken = rospy.Subscriber(topic, kind, self._take, topic, queue_size=1, tcp_nodelay=True)
                self._subscribers.append(taken)
        self._say(kind="ready", missing=sorted(missing))
        for publisher in self._publishers.values():
            publisher.impl.add_subscriber_listener(listener)
            self._hand_over(publisher)  # who came before

    def run(self):
        """Write what comes into the log of ROS until the input ends."""
        while True:
            data = self._pipe.recv(_LARGEST)
            if not data:
                return
            self._rospy.logwarn(data.decode(errors="replace"))

    def _listener(self):
        node = self

        class Listener(self._rospy.SubscribeListener):
            def peer_subscribe(self, topic, publish, publish_single):
                node._hand_over(node._publishers[topic])

        return Listener()

    def _hand_over(self, publisher):
        """Give the bridge the connections of a topic that it has not."""
        with self._lock:
            name, connections = publisher.resolved_name, publisher.impl.connections
            said = json.dumps({"kind": "subscriber", "topic": name}).encode()
            for one in connections:
                if one.id not in self._handed.get(name, ()):
                    with contextlib.suppress(AttributeError, OSError):  # it has gone
                        number = array.array("i", [one.socket.fileno()])
                        self._pipe.sendmsg([said], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, number)])
            self._handed[name] = {one.id for one in connections}

    def _take(self, message, topic):
        content = getattr(message, "data", None)
        content = list(content) if isinstance(content, (list, tuple)) else content
        client = message._connection_header.get("callerid", "?")
        self._say(kind="command", topic=topic, client=client, content=content)

    def _say(self, **fields):
        with contextlib.suppress(BlockingIOError):  # the bridge does not read: a newer command follows
            self._pipe.send(json.dumps(fields).encode(), socket.MSG_DONTWAIT)


def _type(name):
    package, _, kind = name.partition("/")
    try:
        return getattr(importlib.import_module(package + ".msg"), kind)
    except (ImportError, AttributeError):
        return None


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
