"""The benchmark of large collections, on a small one: all its stages run, and say what they took."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "bench_scale.py"


def test_every_stage_runs_and_is_summed_up(tmp_path):
    output = tmp_path / "scale.json"
    command = [sys.executable, SCRIPT, "--images", "12", "--pairs", "20", "--matches", "60", "--output", output]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    stages = json.loads(output.read_text())["stages"]
    assert {"store", "merge", "database"} <= stages.keys()
    assert stages["merge"]["exported"] > 500
    assert all(stage["peak_mb"] > 100 for stage in stages.values())
    assert done.stdout.splitlines()[-1].startswith("12 images, 20 pairs")
    assert [path.name for path in tmp_path.iterdir()] == ["scale.json"]
