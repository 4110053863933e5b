"""The controller's place on the board, in a group of cases: `mavsitl bench wind-hold --only --case wind`."""

import json
import subprocess
import sys


def test_it_is_better_than_the_cascade_aboard_in_wind(tmp_path):
    command = ["bench", "wind-hold", "--only", "--case", "hover-dryden-10", "--seeds", "1", "--jobs", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "mavsitl", *command, "--output", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    scores = {each["controller"]: each for each in json.loads(done.stdout)["standings"]}
    assert scores["wind-hold"]["lost"] == 0
    assert scores["wind-hold"]["score"] > scores["stock"]["score"]
    assert (tmp_path / "report.html").is_file()
