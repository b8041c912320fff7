"""Pure codecs, bytes to SI values: no sockets, no files. The only place with millimetres, degrees and milliseconds."""

__all__ = []  # import armlab.wire.egm or armlab.wire.cdr: each brings its own dependencies
