"""What the commands share: options, settings, output, reports, figures, the log of a command."""

__all__ = []
