"""Pure codecs between bytes and SI values, without I/O; no other code uses millimetres, degrees or milliseconds."""

__all__ = []  # import armlab.wire.egm or armlab.wire.cdr directly; each has its own dependencies
