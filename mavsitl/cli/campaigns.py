"""What the commands that fly many flights share."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from mavsitl.cli.common import whole


def add_run_options(group: Any, default: str) -> None:
    """Who flies a campaign, and the folder of it."""
    group.add_argument("--jobs", type=whole(1, 4096), metavar="N", help="processes (default: one for each core)")
    group.add_argument(
        "--scheduler", type=_scheduler, metavar="ADDRESS",
        help="of a Dask cluster, tcp://HOST:PORT, in place of processes",
    )  # fmt: skip
    group.add_argument("--output", type=Path, metavar="DIR", help=f"folder (default: {default}")


def _scheduler(text: str) -> str:
    if not re.fullmatch(r"(tcp|tls|ucx|wss?)://\S+:\d+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: tcp://HOST:PORT or tls://HOST:PORT")
    return text
