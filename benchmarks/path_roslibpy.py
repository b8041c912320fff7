"""Reader that uses roslibpy as its users do: `path_roslibpy.py PORT COUNT`."""

from __future__ import annotations

import os
import sys
from functools import partial
from typing import Any

import roslibpy
from path_ends import Lines
from path_rosbridge import TOPICS, stamp


def main() -> None:
    port, count = (int(word) for word in sys.argv[1:])
    lines = Lines(count)
    ros = roslibpy.Ros("127.0.0.1", port)
    ros.run(timeout=20)

    def take(kind: str, message: Any) -> None:
        lines.add(kind, stamp(message))

    for topic, (kind, type_) in TOPICS.items():
        roslibpy.Topic(ros, topic, type_).subscribe(partial(take, kind))
    lines.wait()
    os._exit(0)  # the reactor takes seconds to stop


if __name__ == "__main__":
    main()
