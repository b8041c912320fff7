"""Pure codecs between bytes and SI values, without I/O; only they use millimetres, degrees and milliseconds."""

__all__ = []  # import armlab.wire.egm or armlab.wire.cdr: each brings its own dependencies
