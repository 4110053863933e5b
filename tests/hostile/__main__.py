"""All programs of this folder, one after the other: `python -m tests.hostile`. About ten minutes on a quiet machine."""

from __future__ import annotations

import subprocess
import sys

PROGRAMS = ("fields", "rivals", "loss", "ground", "floods", "guided", "fuzz")


def main() -> int:
    codes = [subprocess.call([sys.executable, "-m", f"tests.hostile.{name}"]) for name in PROGRAMS]
    failed = [name for name, code in zip(PROGRAMS, codes, strict=True) if code]
    print(f"missed: {', '.join(failed)}" if failed else "all demands met")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
