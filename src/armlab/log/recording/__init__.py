"""Recordings of armlab: what a link writes while it runs, and cutting, merging and inspecting such files."""

__all__ = []
