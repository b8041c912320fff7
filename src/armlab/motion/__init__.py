"""Motion: profiles from point to point."""

from armlab.motion import profiles

__all__ = ["profiles"]
