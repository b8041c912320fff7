"""Who may command an arm, and what a command is."""

__all__ = []
