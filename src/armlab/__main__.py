"""``python -m armlab`` runs the command ``armlab``."""

from armlab.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
