"""Entry point of ``python -m armlab``, equivalent to the command ``armlab``."""

from armlab.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
