"""Code shared by the commands: options, settings, output, reports, figures and input logs."""

__all__ = []
