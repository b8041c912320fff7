"""Both ends of a path for the programs `path_*.py`: message storage of a reader, and pacing of a bare publisher.

It uses only the standard library, because ROS 1 nodes run under the system's Python. A reader receives a number of
joint states and then prints a line for each message: "J" for joint states or "W" for wrenches, the stamp in the
message, and the time of receipt [ns, wall clock]. With the number 0, it reads until it is terminated, stores nothing,
and prints a line every second: time [ns], number of messages, and the median and longest time from stamp to receipt
[ns]. A publisher prints "ready" and, at the end, the stamps that it sent.
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
SUMMED = 1_000_000_000  # ns, print period of a reader that reads until terminated


class Lines:
    """Messages received by a reader; prints "reading" to standard error at the first joint state.

    A termination signal ends the reading; received messages are still printed.
    """

    def __init__(self, count):
        self._found, self._count, self._left = [], count, count
        self._lock = threading.Lock()  # rospy uses one callback thread per topic
        self.over = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: self.over.set())

    def add(self, kind, stamp_ns):
        """Store a message; called at the start of a callback."""
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
        """Wait until enough messages have arrived, then print them."""
        self.over.wait(PATIENCE if self._count else None)
        self.tell()

    def tell(self):
        """Print the received messages."""
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
    """Call a function with the time [ns] in every period until standard input is closed; then print all the times."""
    say("ready")
    stamps, due = [], time.monotonic()
    while not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
        stamps.append(time.time_ns())
        send(stamps[-1])
        due += PERIOD
    tell(stamps)


def tell(stamps):
    """Print the times at which messages were sent."""
    sys.stdout.write("".join(f"{one}\n" for one in stamps))
    sys.stdout.flush()


def numbers(stamp_ns):
    """Return time-varying positions, velocities and efforts."""
    q = [1e-9 * (stamp_ns % 10**9) + 0.1 * k for k in range(JOINTS)]
    return q, [0.1 * value for value in q], q
