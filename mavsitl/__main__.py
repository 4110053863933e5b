"""``python -m mavsitl``."""

from mavsitl.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
