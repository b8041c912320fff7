"""MCAP files: records, writing, decoding, recovery."""

__all__ = []
