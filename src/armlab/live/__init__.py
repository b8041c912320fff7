"""Views in the browser: a recording, a running bridge, a fleet; arms, forces with their uncertainty, curves.

It needs viser (extra `live`), which loads on first use. Everything stays on this computer.
"""

from __future__ import annotations

from armlab.live.recording_view import Player, read_arms
from armlab.live.server import address, start, stop

__all__ = ["Player", "address", "read_arms", "start", "stop"]
