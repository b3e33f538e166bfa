"""OUT/progress.json: what a run does, and that only one works in a folder."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sgam_core.errors import InputError, StageError
from sgam_sfm.progress import Stages
from sgam_sfm.run_record import read_run_record, recording


def test_a_run_tells_its_stage_while_it_lasts(tmp_path):
    stages = Stages(quiet=True)
    with recording(tmp_path, stages), stages.stage("Matching pairs", 10) as advance:
        advance(4)
        record = read_run_record(tmp_path)
        assert (record.state, record.stage, record.total) == ("running", "Matching pairs", 10)
    record = read_run_record(tmp_path)
    assert (record.state, record.stage, record.error) == ("done", "Matching pairs", "")


@pytest.mark.parametrize(
    ("error", "state", "reason"),
    [
        (KeyboardInterrupt(), "stopped", "stopped by Ctrl-C"),
        (StageError("COLMAP failed"), "failed", "COLMAP failed"),
        (ValueError("odd"), "failed", "ValueError: odd"),
    ],
)
def test_how_a_run_ended_is_kept(tmp_path, error, state, reason):
    with pytest.raises(type(error)), recording(tmp_path, Stages(quiet=True)):
        raise error
    record = read_run_record(tmp_path)
    assert (record.state, record.error) == (state, reason)


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    second = recording(tmp_path, Stages(quiet=True))
    with recording(tmp_path, Stages(quiet=True)), pytest.raises(InputError) as error:
        second.__enter__()
    assert str(error.value).startswith(f"another run is working in '{tmp_path}'")
    assert str(error.value).endswith("wait for it, stop it, or choose another --output")


def test_a_killed_run_is_told_from_a_running_one(tmp_path):
    code = (
        "import sys, os, signal; from pathlib import Path; from sgam_sfm.run_record import recording;"
        "from sgam_sfm.progress import Stages; stages = Stages(quiet=True);"
        "run = recording(Path(sys.argv[1]), stages); run.__enter__();"
        "stage = stages.stage('Mapping', 3); stage.__enter__(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert json.loads((tmp_path / "progress.json").read_text())["state"] == "running"
    record = read_run_record(tmp_path)
    assert (record.state, record.stage, record.error) == ("killed", "Mapping", "it ended without a word: killed?")


def test_no_run(tmp_path):
    assert read_run_record(tmp_path) is None
    Path(tmp_path / "progress.json").write_text("{")
    assert read_run_record(tmp_path) is None
