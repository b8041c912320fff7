"""Shared code of the commands: options, settings, output, reports, figures, input logs."""

__all__ = []
