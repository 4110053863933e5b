"""Compiled and plain text give the same bits."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from mavsitl.compiled import JIT
from tests.control.exercise import digests


def test_the_plain_text_gives_the_same_bits_as_the_compiled_one() -> None:
    other = subprocess.run(
        [sys.executable, "-m", "tests.control.exercise"],
        env={**os.environ, "MAVSITL_JIT": "0" if JIT else "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert digests() == json.loads(other.stdout)
