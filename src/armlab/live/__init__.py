"""Browser views of recordings, running bridges and fleets: arms, forces with their uncertainty, and curves.

The views require viser (extra `live`), which is imported on first use. The views can be opened only on this computer.
"""

from __future__ import annotations

from armlab.live.recording_view import Player, read_arms
from armlab.live.server import address, start, stop

__all__ = ["Player", "address", "read_arms", "start", "stop"]
