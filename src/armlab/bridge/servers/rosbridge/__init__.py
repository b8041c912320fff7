"""rosbridge v2 over WebSocket, for roslibpy, roslibjs and web pages (docs/ros.md)."""

__all__ = []
