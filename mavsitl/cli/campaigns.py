"""What the commands that fly many flights share: their options, and the workers that these ask for."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import UsageError, whole

if TYPE_CHECKING:
    from mavsitl.campaign.workers import Workers


def add_run_options(group: Any, default: str) -> None:
    """Who flies a campaign, and the folder of it."""
    group.add_argument("--jobs", type=whole(1, 4096), metavar="N", help="processes (default: one for each core)")
    group.add_argument(
        "--scheduler", type=_scheduler, metavar="ADDRESS",
        help="of a Dask cluster, tcp://HOST:PORT, in place of processes",
    )  # fmt: skip
    group.add_argument("--output", type=Path, metavar="DIR", help=f"folder (default: {default})")


def check_run_options(options: argparse.Namespace) -> None:
    if options.jobs is not None and options.scheduler is not None:
        raise UsageError("--jobs: not with --scheduler, whose workers are what they are")


def crew(options: argparse.Namespace, at_once: int) -> Workers:
    """`at_once`: as many flights as can be in the air together; more processes would have nothing to do."""
    from mavsitl.campaign import workers

    if options.scheduler is None:
        return workers.local(min(options.jobs or workers.cores(), at_once))
    import logging

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong comes as our own error
    return workers.Dask(options.scheduler)


def _scheduler(text: str) -> str:
    if not re.fullmatch(r"(tcp|tls|ucx|wss?)://\S+:\d+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: tcp://HOST:PORT or tls://HOST:PORT")
    return text
