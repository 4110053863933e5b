"""docs/examples/github-actions.yml: its form, its commands, and the step of its second job as it stands there."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from mavsitl import cli

EXAMPLE = Path(__file__).resolve().parents[2] / "docs/examples/github-actions.yml"
WORKFLOW: dict[str, Any] = YAML(typ="safe").load(EXAMPLE.read_text())

PROGRAM = """\
from mavsitl.link.udp import LOOPBACK
from mavsitl.codec import parse
import socket
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
    port.bind((LOOPBACK, 14540))
    port.settimeout(60.0)
    print({frame.system_id for frame in parse(port.recv(2048))})
"""


def scripts() -> list[str]:
    return [step["run"] for job in WORKFLOW["jobs"].values() for step in job["steps"] if "run" in step]


def test_it_is_a_workflow_as_github_reads_them() -> None:
    """By the schema that check-jsonschema has with it."""
    checker = Path(sys.executable).parent / "check-jsonschema"
    arguments = ["--builtin-schema", "vendor.github-workflows", str(EXAMPLE)]
    done = subprocess.run([str(checker), *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_its_commands_parse() -> None:
    lines = re.findall(r"^ *mavsitl (.*?)(?: [>&#].*)?$", "\n".join(scripts()), re.M)
    assert len(lines) == 2
    for line in lines:
        assert callable(cli.build_parser().parse_args(shlex.split(line)).run)


def test_logs_are_kept_from_where_they_are_written() -> None:
    steps = [step for job in WORKFLOW["jobs"].values() for step in job["steps"]]
    kept = [step["with"]["path"] for step in steps if step.get("uses", "").startswith("actions/upload-artifact@")]
    assert any("--run-dir logs" in script for script in scripts())
    assert any("logs/" in path.split() for path in kept)


@pytest.mark.sockets
def test_the_step_that_flies_beside_a_vehicle_does(tmp_path: Path) -> None:
    """In a network namespace, where PX4's ports are free; the program waits for the vehicle's first word."""
    if shutil.which("unshare") is None or os.geteuid() != 0:
        pytest.skip("needs root to make a network namespace")
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "takeoff_and_land.py").write_text(PROGRAM)
    [script] = [each for each in scripts() if "mavsitl vehicle" in each]
    done = subprocess.run(
        ["unshare", "--net", "bash", "-e", "-c", f"ip link set lo up\n{script}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300.0, check=False,
        env=os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == ["SYS_AUTOSTART    5001", "{1}"]
    assert (tmp_path / "logs" / "vehicle.ulg").stat().st_size > 10_000
    assert (tmp_path / "vehicle.txt").read_text().endswith("logs: logs\n")
