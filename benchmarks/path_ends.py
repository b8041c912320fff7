"""Both ends of a path, for the programs `path_*.py`: what a reader keeps, and the pace of a bare publisher.

Only the standard library: the nodes of ROS 1 run under the system's Python. A reader takes a number of joint states and
then prints a line for each message: "J" for joint states or "W" for wrenches, the stamp in the message, and when it was
received [ns, wall clock]. With the number 0 it reads until it is ended, keeps nothing, and prints a line every
second: when [ns], how many messages, and the median and the longest from stamp to receipt [ns]. A publisher says
"ready" and, in the end, prints the stamps that it sent.
"""

from __future__ import annotations

import select
import signal
import sys
import threading
import time

PERIOD = 0.004  # s
ROBOT = "yumi_left"
PATIENCE = 150.0  # s
JOINTS = 7
SUMMED = 1_000_000_000  # ns of messages that a line tells of, when a reader reads for ever


class Lines:
    """What a reader received; says "reading" on standard error at the first joint state.

    A signal to end ends the reading, and what came is printed all the same.
    """

    def __init__(self, count):
        self._found, self._count, self._left = [], count, count
        self._lock = threading.Lock()  # rospy calls back in a thread for each topic
        self.over = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: self.over.set())

    def add(self, kind, stamp_ns):
        """Keep a message; call it first in a callback."""
        came = time.time_ns()
        with self._lock:
            self._found.append((kind, stamp_ns, came))
            if not self._count and came - self._found[0][2] > SUMMED:
                self._sum_up()
        if kind == "J":
            if self._left == self._count:
                say("reading")
            self._left -= 1
            if self._left == 0:
                self.over.set()

    def wait(self):
        """Wait until enough has come, then print."""
        self.over.wait(PATIENCE if self._count else None)
        self.tell()

    def tell(self):
        """Print what came."""
        if self._count:
            self._print_all()
        elif self._found:
            self._sum_up()

    def _sum_up(self):
        found, self._found = self._found, []
        ages = sorted(came - sent for _, sent, came in found)
        sys.stdout.write(f"{found[-1][2]} {len(ages)} {ages[len(ages) // 2]} {ages[-1]}\n")
        sys.stdout.flush()

    def _print_all(self):
        sys.stdout.write("".join(f"{kind} {sent} {came}\n" for kind, sent, came in list(self._found)))
        sys.stdout.flush()


def say(word):
    """Write a word to standard error."""
    sys.stderr.write(word + "\n")
    sys.stderr.flush()


def paced(send):
    """Call a function with the time [ns] every period until standard input is closed; then print all the times."""
    say("ready")
    stamps, due = [], time.monotonic()
    while not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
        stamps.append(time.time_ns())
        send(stamps[-1])
        due += PERIOD
    tell(stamps)


def tell(stamps):
    """Print the times that were sent."""
    sys.stdout.write("".join(f"{one}\n" for one in stamps))
    sys.stdout.flush()


def numbers(stamp_ns):
    """Return positions, velocities and efforts that change with time."""
    q = [1e-9 * (stamp_ns % 10**9) + 0.1 * k for k in range(JOINTS)]
    return q, [0.1 * value for value in q], q
