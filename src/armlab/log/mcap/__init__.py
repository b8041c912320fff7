"""MCAP files: records, writing, decoding, repair."""

__all__ = []
