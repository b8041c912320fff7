"""Run the command ``armlab`` as ``python -m armlab``."""

from armlab.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
