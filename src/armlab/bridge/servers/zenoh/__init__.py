"""Zenoh: rows, parameters, events and commands of a cell under ``armlab/<lab>/<robot>/`` (docs/how_to/zenoh.md)."""

__all__ = []
