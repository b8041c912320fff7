"""Browser views of a recording, a running bridge or a fleet, with arms, forces including uncertainty, and curves.

The views need viser (extra `live`), which is loaded on first use. The server is accessible only from this computer.
"""

from __future__ import annotations

from armlab.live.recording_view import Player, read_arms
from armlab.live.server import address, start, stop

__all__ = ["Player", "address", "read_arms", "start", "stop"]
