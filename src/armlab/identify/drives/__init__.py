"""Models of the drives beyond rigid-body dynamics: friction maps, torque ripple, warm-up."""

__all__ = []  # `armlab.identify` exports the public names
